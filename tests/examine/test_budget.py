"""The budget: what decides comes first, every finished stage is kept, and calls as a budget give the same report anywhere."""

import re
import time
from functools import partial

import mechanisms
import numpy as np
import pytest

import bench

examine = partial(bench.examine, progress=False)
THETA = [0.4, 0.3, 0.5]


def cost(x):
    return float(np.sin(x[0]) * x[1] + x[1] ** 3 * x[2])


def grad(x):
    return np.array([np.cos(x[0]) * x[1], np.sin(x[0]) + 3 * x[1] ** 2 * x[2], x[1] ** 3])


@pytest.mark.parametrize("calls", [8, 29, 243])
def test_a_gradient_10_percent_off_never_reads_like_a_right_one(calls):
    """8 calls: one cost, one gradient, and two costs per component."""
    right = examine(cost, THETA, grad=grad, calls=calls)
    wrong = examine(cost, THETA, grad=lambda x: 1.1 * grad(x), calls=calls)
    assert (right.status, right.derivative) == (0, "right")
    assert (wrong.status, wrong.derivative) == (1, "wrong")
    for report in (right, wrong):
        assert report.spent.costs + report.spent.gradients <= calls
        assert "3 of 3 components" in str(report)


def test_fewer_calls_than_components_decide_nothing():
    for calls in (1, 4, 7):
        report = examine(cost, THETA, grad=grad, calls=calls)
        assert (report.status, report.cause) == (3, "undecided"), calls
        assert re.search(r"[0-2] of 3 components", str(report))


@pytest.mark.parametrize(
    ("size", "settings"), [(2, {}), (16, {}), (40, {}), (2, {"sigma": 0.1}), (5, {"sigma": [0.01, 0.1]})]
)
def test_with_the_proposed_calls_nothing_is_left_out(size, settings):
    def examined(calls):
        return examine(
            lambda x: float(np.sin(x).sum()), np.linspace(0.3, 1.2, size), grad=np.cos, calls=calls, **settings
        )

    for calls in (5, 40, 700):
        report = examined(calls)
        assert report.left_out
        (proposed,) = re.findall(r"calls=(\d+)", report.advice)
        assert not examined(int(proposed)).left_out


@pytest.mark.parametrize(("budget", "size"), [(1, 2), (20, 100)])
def test_the_proposed_budget_suffices_for_a_slow_cost(now, budget, size):
    def slow(x):
        now[0] += 20.0
        return float(x @ x)

    def gradient(x):
        now[0] += 60.0
        return 2 * x

    report = examine(slow, np.ones(size), grad=gradient, budget=budget)
    assert report.cause == "undecided"
    (proposed,) = re.findall(r"budget=(\d+)s", report.advice)
    assert examine(slow, np.ones(size), grad=gradient, budget=float(proposed)).derivative == "right"


@pytest.mark.parametrize("factor", [1.0, 1.002])
def test_verdicts_do_not_depend_on_load(now, factor):
    """A cost that is four times slower, as on a loaded machine, gets the same verdict."""

    def swinging(seconds):
        def cost(x):
            now[0] += seconds
            return mechanisms.swinging(x)

        return cost

    def slope(x):
        return mechanisms.swinging(x, slope=True) * [1.0, factor]

    reports = [examine(swinging(seconds), [0.7, 0.3], grad=slope, budget=1) for seconds in (1e-4, 4e-4)]
    assert len({(report.status, report.cause) for report in reports}) == 1
    assert reports[0].status == (factor > 1.0)


def test_sigma_that_was_not_measured_is_not_decided():
    report = examine(cost, THETA, grad=grad, sigma=0.1, calls=60)
    assert (report.status, report.cause, report.derivative) == (3, "unmeasured", "right")
    assert "sigma 0.10: not measured" in report.noise_answer


def test_first_calls_have_a_budget_of_their_own(now):
    """0.4 s of compilation within a budget of 0.3 s: nothing is omitted, and nothing is compiled twice."""
    compiled = []

    def compiling(function, name):
        def call(x):
            if name not in compiled:
                compiled.append(name)
                now[0] += 0.4
            now[0] += 1e-4
            return function(x)

        return call

    report = examine(compiling(cost, "cost"), THETA, grad=compiling(grad, "grad"), budget=0.3)
    assert report.status == 0
    assert compiled == ["cost", "grad"]
    assert report.spent.compile_s == pytest.approx(0.8, abs=0.01)
    assert report.spent.seconds < 0.4


def test_a_gradient_that_is_right_at_one_theta_is_said_to_be_right_there_only():
    """A cache that is never cleared gives the right gradient at the first theta, where few calls end the check."""

    def stale(x):
        return np.cos(np.array([0.3, 0.7]))

    few = examine(lambda x: float(np.sin(x).sum()), [0.3, 0.7], grad=stale, calls=30)
    assert "at this theta only" in few.conclusion
    assert "other thetas around this one (calls)" in str(few)
    many = examine(lambda x: float(np.sin(x).sum()), [0.3, 0.7], grad=stale, calls=3000)
    assert many.cause == "stale_gradient"


def test_an_interruption_that_a_compiled_library_turns_into_its_own_error_is_the_budgets():
    def slow(x):
        try:
            end = time.perf_counter() + 0.2
            while time.perf_counter() < end:
                pass
        except BaseException:
            raise RuntimeError("the callback failed") from None
        return cost(x)

    report = examine(slow, THETA, grad=grad, budget=0.5)
    assert "the callback failed" not in str(report)
    assert report.left_out


@pytest.mark.parametrize("which", ["cost", "gradient"])
def test_exceptions_at_random_calls_are_named_as_such(which):
    random = np.random.default_rng(3)

    def fragile(function, share):
        def call(x):
            if random.random() < share and call.count:
                raise ValueError("no convergence")
            call.count += 1
            return function(x)

        call.count = 0
        return call

    # few gradients are computed at theta, and many on lines
    given = (fragile(cost, 0.1), grad) if which == "cost" else (cost, fragile(grad, 0.02))
    report = examine(given[0], THETA, grad=given[1], calls=2000)
    assert (report.status, report.cause) == (1, "nondeterministic"), str(report)
    assert "equal calls raise an exception or return a number" in report.conclusion
