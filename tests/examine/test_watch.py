"""A watched loop: faults are named where they begin, sound loops are silent, and the loop itself is unchanged."""

import csv
import math
import random
import time

import numpy as np
import pytest

import bench
from bench.gradient import FAULTS

STIFFNESS = {"": 400.0, "detached": 400.0, "unstable": 1e5}
"""Stiffness of the floor by fault: the last is beyond the limit 4 / dt^2 of the step."""


def rollout(theta, fault=""):
    """Return the cost of a ball's first height and speed above a spring floor; a force that is detached has no imaginary part."""
    x, v = theta
    for _ in range(40):
        force = STIFFNESS[fault] * (x.real < 0) * x
        v = v - 0.01 * (9.8 + (force.real if fault == "detached" else force))
        x = x + 0.01 * v
    return (x - 0.3) ** 2


def descend(watched, fault="", at=0, updates=600, seed=0):
    """Return the log of normalized gradient descent, and the last theta; from update ``at`` on it has a ``fault``."""
    theta = np.random.default_rng(seed).normal([0.2, -1.0], 0.05)
    log = bench.watch(lambda x: float(rollout(x, now)), every=20, share=math.inf) if watched else None
    for i in range(updates):
        now = fault if i >= at else ""
        gradient = np.array([rollout(theta + 1e-30j * one, now).imag for one in np.eye(2)]) / 1e-30
        if log is not None:
            log(theta, gradient)
        theta = theta - 2e-4 * gradient / np.linalg.norm(gradient)
    return log, theta


@pytest.mark.parametrize("seed", range(2))
def test_a_sound_loop_is_silent(seed):
    log, _ = descend(True, updates=200, seed=seed)
    assert log.first is None
    assert "no fault" in str(log)


@pytest.mark.parametrize(("sign", "lowers"), [(1.0, 1.0), (-1.0, 0.0)])
def test_a_check_tells_the_jumps_along_the_last_step_and_whether_a_step_against_the_gradient_lowers_the_cost(
    sign, lowers
):
    log = bench.watch(lambda x: float(x @ x) + 5.0 * (x[0] > 1.5), every=1, share=math.inf)
    for theta in np.array([[2.0, 1.0], [1.0, 1.0]]):
        log(theta, sign * 2.0 * theta)
    last = log.rows[-1]
    assert (last["jumps"], last["lowers"]) == (1, lowers)
    assert last["largest_jump"] == pytest.approx(5.0, rel=0.2)


def test_a_term_that_is_detached_is_named_from_its_iteration_on():
    log, _ = descend(True, "detached", 200, 260)
    iteration, reason = log.first
    assert iteration == 200
    assert reason in FAULTS
    assert f"iteration 200 on ({reason}" in str(log)


def test_a_small_fault_that_lasts_is_named_and_doubt_is_no_praise():
    log = bench.watch(lambda x: float(x @ x), every=1, share=math.inf)
    for at in np.random.default_rng(0).normal(size=(5, 60)):
        log(at, 2.0 * at * (np.arange(60) > 0))
    assert log.first[0] == 2
    rng = np.random.default_rng(0)
    log = bench.watch(lambda x: float(x @ x) + rng.normal(), every=1, share=math.inf)
    log(np.ones(2), 4.0 * np.ones(2))
    assert str(log).endswith("nothing is known of the gradient")


def test_a_step_that_becomes_unstable_is_named():
    log, _ = descend(True, "unstable", 200, 240)
    assert log.first == (200, "explodes")


def test_theta_and_random_numbers_are_those_without_the_log():
    def cost(theta):
        return float(theta @ theta) + 0.0 * np.random.random() + 0.0 * random.random()  # noqa: NPY002

    before = random.getstate(), np.random.get_state()  # noqa: NPY002
    log = bench.watch(cost, every=1, share=math.inf)
    log(np.ones(3), 2 * np.ones(3))
    np.testing.assert_equal((random.getstate(), np.random.get_state()), before)  # noqa: NPY002
    assert np.array_equal(*(descend(is_watched, updates=60)[1] for is_watched in (False, True)))


def test_the_share_of_time_limits_the_checks_but_two_that_may_compile(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def cost(theta):
        now[0] += 1.0 if log.iteration > 1 else 100.0
        return float(theta @ theta)

    log = bench.watch(cost, every=1, share=0.1)
    for _ in range(1000):
        log(np.ones(2), 2 * np.ones(2))
        now[0] += 10.0
    log(np.ones(2), 1e3 * np.ones(2))
    assert log.first == (1000, "explodes"), "the norm needs no check"
    loop = now[0] - sum(row["seconds"] for row in log.rows[:2])
    spent = sum(row["seconds"] for row in log.rows[2:])
    assert 0.05 * loop < spent <= 0.1 * loop


@pytest.mark.parametrize("is_closed_over", [True, False])
def test_what_changes_in_a_loop_in_jax_is_that_of_the_iteration(is_closed_over):
    """Data and a key of integers, closed over by the cost or given as w; the last gradient is twice too large."""
    jax = pytest.importorskip("jax")
    loss = jax.jit(lambda p, w: ((p["slope"] * w["data"] + jax.random.normal(w["key"], (3,))) ** 2).mean())
    now, p = {}, {"slope": jax.numpy.array(0.5)}
    log = bench.watch((lambda p: loss(p, now)) if is_closed_over else loss, every=1, share=math.inf)
    for i, factor in enumerate((1, 1, 1, 2)):
        now = {"data": jax.numpy.arange(3.0) + i, "key": jax.random.PRNGKey(i)}
        log(p, {"slope": factor * jax.grad(loss)(p, now)["slope"]}, *() if is_closed_over else (now,))
    assert [row["reason"] for row in log.rows] == [""] * 4
    assert log.first[0] == 3


@pytest.mark.parametrize(
    ("theta", "gradient", "reason"),
    [
        (1.0, [math.nan, 1.0], "nan_gradient"),
        (1.0, [2.0, -2.0], "wrong_adjoint"),
        (math.nan, [math.nan, 1.0], "not_finite"),
        (1e200, [math.inf, 1.0], "not_finite"),
    ],
)
def test_wrong_numbers_are_named(theta, gradient, reason):
    log = bench.watch(lambda x: float(x @ x), every=1, share=math.inf)
    log(np.array([theta, 1.0]), np.array(gradient))
    assert log.first == (0, reason)


def test_a_failing_cost_does_not_end_the_loop(tmp_path):
    log = bench.watch(lambda x: {}["missing"], every=1, out=tmp_path / "log.csv", share=math.inf)
    log(np.ones(2), np.ones(2))
    log(np.ones(2), np.ones(3))
    assert log.first is None
    assert "2 with errors: the cost cannot be called at theta: KeyError: 'missing'" in str(log)
    assert str(log).endswith("nothing is known of the gradient")
    with (tmp_path / "log.csv").open() as file:
        assert [row["iteration"] for row in csv.DictReader(file)] == ["0", "1"]


def test_a_chart_is_drawn(tmp_path):
    log, _ = descend(True, "detached", 20, 40)
    bench.watch(abs).draw(tmp_path / "log.png")  # before the loop
    log.draw(tmp_path / "log.png")
    assert (tmp_path / "log.png").stat().st_size > 1000


@pytest.mark.parametrize(
    "given", [{"cost": 1}, {"every": 0}, {"every": -1}, {"every": 1.5}, {"share": 0}, {"share": "a"}, {"share": None}]
)
def test_bad_input_is_named(given):
    with pytest.raises(bench.UserError, match="^{}={!r} is not".format(*next(iter(given.items())))):
        bench.watch(**{"cost": abs} | given)


def test_a_file_that_cannot_be_written_is_named_before_the_loop_begins(tmp_path):
    for out in (tmp_path / "missing" / "log.csv", tmp_path):
        with pytest.raises(OSError, match=str(out)):
            bench.watch(abs, out=out)


def test_neither_a_theta_that_is_none_nor_a_full_disk_ends_the_loop(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    log = bench.watch(lambda x: float(x @ x), every=2, out=folder / "log.csv", share=math.inf)
    folder.rename(tmp_path / "away")
    for theta in (np.ones(2), "text", np.ones(2), np.ones(2)):
        log(theta, 2 * np.ones(2))
    assert [row["iteration"] for row in log.rows] == [0, 2]
    assert log.first is None
    assert "log.csv" in str(log)
    log(np.array([np.nan, 1.0]), np.ones(2))
    assert log.first == (4, "not_finite")
    folder.mkdir()
    for _ in range(2):
        log(np.ones(2), 2 * np.ones(2))
    with (folder / "log.csv").open() as file:
        assert [row["iteration"] for row in csv.DictReader(file)] == ["0", "2", "4", "6"]
    assert "log.csv" not in str(log)


def needs_w(theta, w):
    return float(theta @ w)


def fails_later(theta, calls=[]):  # noqa: B006
    calls.append(theta)
    return 1.0 if len(calls) == 1 else {}["worker"]


@pytest.mark.parametrize(
    ("cost", "theta", "gradient", "given", "reason"),
    [
        (needs_w, np.ones(2), np.ones(2), (), "missing 1 required positional argument: 'w'"),
        (abs, np.ones(1), np.ones(1), (np.ones(2),), "takes exactly one argument (2 given)"),
        (abs, np.ones(2), None, (), "the gradient is NoneType None, and theta has shape (2,)"),
        (abs, iter([np.ones(2)]), np.ones(2), (), "theta is of type list_iterator: theta consists of real numbers"),
        (fails_later, np.ones(2), np.ones(2), (), "KeyError: 'worker'"),
        (abs, np.ones(2), np.ones(2), (), "it returned an array of shape (2,)"),
    ],
)
def test_misuse_is_a_row_with_its_reason(cost, theta, gradient, given, reason):
    log = bench.watch(cost, every=1)
    log(theta, gradient, *given)
    assert f"1 with errors: {log.rows[0]['reason']}" in str(log)
    assert reason in str(log)


def test_a_theta_that_changes_its_structure_is_checked_as_it_is():
    log = bench.watch(lambda x: float(x @ x), every=1, share=math.inf)
    for size in (2, 3):
        log(np.ones(size), 2 * np.ones(size))
    assert [row["verdict"] for row in log.rows] == ["smooth"] * 2


def test_single_precision_behind_a_float_and_noise_of_the_cost_raise_no_alarm():
    rng = np.random.default_rng(0)

    def single(theta):
        x = theta.astype(np.float32)
        return float((np.sin(3 * x) ** 2).sum() + np.float32(0.3) * (x @ x))

    for cost in (single, lambda x: single(x) + 1e-3 * rng.standard_normal()):
        log = bench.watch(cost, every=1, share=math.inf)
        for theta in np.random.default_rng(1).standard_normal((20, 5)):
            log(theta, 3 * np.sin(6 * theta) + 0.6 * theta)
        assert log.first is None, str(log)


def test_a_module_of_torch_with_minibatches_is_trained_as_without_the_log():
    torch = pytest.importorskip("torch")

    def train(is_watched):
        torch.manual_seed(0)
        module, data = torch.nn.Linear(3, 1), torch.randn(8, 3)
        optimizer, theta = torch.optim.SGD(module.parameters(), lr=0.1), dict(module.named_parameters())
        log = bench.watch(lambda p, w: torch.func.functional_call(module, p, (w,)).square().mean(), 1, share=math.inf)
        for i in range(6):
            optimizer.zero_grad()
            w = data[torch.randperm(8)[:4]]
            module(w).square().mean().backward()
            if is_watched:
                log(theta, {name: one.grad * (i < 5 or name == "bias") for name, one in theta.items()}, w)
            optimizer.step()
        return log, [*theta.values(), torch.rand(3)]

    (log, watched), (_, alone) = train(True), train(False)
    assert all(map(torch.equal, watched, alone))
    assert log.first[0] == 5, str(log)
    assert (log.rows[1]["precision"], log.rows[1]["gradient_spread"] > 0) == (2.0**-23, True)
