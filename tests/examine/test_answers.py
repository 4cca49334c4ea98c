"""What the report says: answers rest on what was measured, and commands can be pasted."""

import re
from functools import partial

import numpy as np
import pytest

import bench

examine = partial(bench.examine, progress=False, calls=3000)
THETA = [1.0, 2.0]


def cost(x):
    return float(x[0] ** 2 + 3 * x[1])


def gradient(x, factor=1.0):
    return [2 * factor * x[0], 3.0]


def wrong(x):
    return gradient(x, 1.5)


@pytest.mark.parametrize("settings", [{}, {"sigma": 0.1, "calls": 200}])
def test_noise_that_was_not_measured_gets_no_answer(settings):
    report = examine(cost, THETA, grad=wrong, **settings)
    assert (report.derivative, report.use) == ("wrong", "not measured")


@pytest.mark.parametrize(("edge", "status", "cause"), [(1e-3, 0, "smooth"), (1e-6, 3, "nonfinite")])
def test_a_cost_that_fails_near_theta_is_reported(edge, status, cause):
    def failing(x):
        if x[0] > 1.0 + edge:
            raise ValueError("the solver diverged")
        return cost(x)

    report = examine(failing, THETA, grad=gradient)
    assert (report.status, report.cause) == (status, cause)
    said = report.problems if status else report.warnings
    assert any("nearest at theta[0] +" in text for text in said)


@pytest.mark.parametrize(
    ("ending", "said"), [("raise", "diverged (test_answers.py:"), ("return", "the cost returned None")]
)
def test_a_note_says_where_the_users_code_failed(ending, said):
    def failing(x):
        if x[0] > 1.0 + 1e-6:
            if ending == "raise":
                raise ValueError("diverged")
            return None
        return cost(x)

    (note,) = (line for line in str(examine(failing, THETA, grad=gradient)).splitlines() if line.startswith("note"))
    assert said in note
    assert "<" not in note  # no function that calls the user's


def test_a_bias_that_is_small_enough_is_no_contradiction():
    def noisy(x, w):
        return [2.12 * x[0] + 0.3 * w[0], 3.0]

    report = examine(lambda x, w: cost(x), THETA, grad=noisy, noise=1, calls=20_000)
    assert report.derivative_cause == "biased"
    assert "usable to 10%. The bias of the mean gradient is below " in report.noise_answer


def test_a_gradient_that_changes_within_a_thousandth_has_no_noise_of_a_short_float():
    """As over many contacts, each of which begins at another step for neighbouring thetas."""
    report = examine(cost, THETA, grad=lambda x: gradient(x) + 0.3 * np.sin(3e3 * x))
    assert report.derivative == "wrong"
    assert "short float" not in str(report)


def test_sigma_by_input_is_a_range():
    report = examine(lambda x: float(x @ x), np.ones(4), grad=lambda x: 2 * x, sigma=[[0.02, 0.02, 20.0, 0.05]])
    assert "Under noise of sigma 0.020 to 20:" in report.noise_answer
    assert "sigma 20" not in str(report)


def test_a_problem_is_said_of_the_sigmas_that_show_it():
    report = examine(lambda x: float(x @ x + (x[0] > 1.2)), np.ones(2), grad=lambda x: 2 * x, sigma=[0.01, 0.2])
    assert report.noise_answer.startswith("Under noise of sigma 0.20: NOT usable. biased")


def test_a_cost_without_a_gradient_gets_what_smoothing_gives_under_noise():
    report = examine(lambda x: float(x[0] ** 2 + (x[0] > 1.05)), [1.0], sigma=0.1, calls=6000)
    answer = report.noise_answer
    assert answer.startswith(
        "Under noise of sigma 0.10: 1 jump within 4 sigma on 1 line, smoothing has an error of 10% after "
    )
    assert answer in str(report).splitlines()[1]
    (row,) = report.sigma_rows()
    assert row["norm"] == pytest.approx(5.5, abs=0.2)
    assert row["method"] == "smoothing"


@pytest.mark.parametrize("pairs", [128, 1024])
def test_no_bound_on_the_bias_is_tighter_than_its_draws_support(pairs):
    """A linear cost: an event that none of 2 n draws meets is as likely as 3 in them, and moves the cost by 8 sigma."""
    report = examine(lambda x: float(x[0]), [1.0], grad=lambda x: [1.0], sigma=0.1, calls=4 * pairs + 2000)
    bound = float(re.search(r"may add ([\d.]+)%", report.noise_answer)[1])
    assert bound > 100.0 * 3.0 / (2.0 * report.smoothed[0].pairs), str(report)


def test_a_usable_gradient_has_a_bias_below_that_of_a_usable_one():
    """Near a minimum, an event that no draw meets could move the cost by more than grad J does."""
    report = examine(lambda x: float(x[0] ** 3), [0.1], grad=lambda x: [3 * x[0] ** 2], sigma=0.1, calls=20_000)
    assert report.use == "usable"
    below, more = map(float, re.search(r"below ([\d.]+)%, .* may add (\d+)%", report.noise_answer).groups())
    assert below < 10.0 < more


def test_the_advice_names_what_a_user_can_follow():
    """An entry of a large array has no name in a program, nor has a random direction."""
    theta = {"mass": 1.5, "w1": np.linspace(0.1, 0.9, 24).reshape(6, 4)}

    def quadratic(x):
        return float(x["mass"] ** 2 + (x["w1"] ** 3).sum())

    def off(x):
        return {"mass": 2 * x["mass"], "w1": 3 * x["w1"] ** 2 * np.linspace(0.5, 0.9, 24).reshape(6, 4)}

    assert "follow w1 through" in examine(quadratic, theta, grad=off).advice
    single = {"mass": 1.5, "gains": np.array([0.3, 0.4])}

    def scaled(x):
        return {"mass": 2 * x["mass"], "gains": np.array([1.0, 2.0])}

    report = examine(lambda x: float(x["mass"] ** 2 + x["gains"].sum()), single, grad=scaled)
    assert "follow gains[1] through" in report.advice


@pytest.mark.parametrize(("factor", "is_shown"), [(0.6, False), (0.99, True)])
def test_a_refined_cost_is_asked_for_where_it_can_decide(factor, is_shown):
    """Smooth costs with a fixed program are compared with a refined cost only where the error is as small as a discretisation's."""

    def off(x):
        return [2 * x[0], 3.0 * (factor + 0.001 * x[0])]

    report = examine(cost, THETA, grad=off)
    assert report.status == 1
    assert ("refined=COST" in report.advice) == is_shown
