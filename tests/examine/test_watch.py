"""A watched loop: faults are named where they begin, sound loops are silent, and the loop itself is unchanged."""

import csv
import math
import random
import time

import numpy as np
import pytest

import bench
from bench.gradient import FAULTS

SEGMENTS, STEPS, DT = 4, 40, 0.025
SOFT, TOO_STIFF = 400.0, 1e4
"""Stiffnesses of the floor: the second is beyond the limit 4 / DT^2 of the step."""


def rollout(theta, stiffness=SOFT, forget=False):
    """Return the cost of forces on a ball above a spring floor, and its derivative; ``forget`` detaches the spring."""
    x, v, total = 0.5, 0.0, 0.0
    dx, dv, slope = np.zeros((3, SEGMENTS))
    for t in range(STEPS):
        i = t * SEGMENTS // STEPS
        k = stiffness * (x < 0)
        own = np.eye(SEGMENTS)[i]
        v, dv = v + DT * (theta[i] - 9.8 - k * x), dv + DT * (own - (0 if forget else k) * dx)
        x, dx = x + DT * v, dx + DT * dv
        total, slope = (
            total + DT * ((x - 0.3) ** 2 + 1e-3 * theta[i] ** 2),
            slope + DT * (2 * (x - 0.3) * dx + 2e-3 * theta[i] * own),
        )
    return total, slope


def adam(watched, seed=0, updates=600, fault="", at=0):
    """Run Adam and return its log and last theta; from update ``at`` on it has a ``fault``."""
    theta, mean, square = np.random.default_rng(seed).normal(0.0, 1.0, SEGMENTS), np.zeros(SEGMENTS), np.zeros(SEGMENTS)
    setting = {"stiffness": SOFT}
    log = bench.watch(lambda x: rollout(x, **setting)[0], every=20, share=math.inf, seed=seed) if watched else None
    for i in range(updates):
        if fault == "unstable" and i >= at:
            setting["stiffness"] = TOO_STIFF
        gradient = rollout(theta, **setting, forget=fault == "detached" and i >= at)[1]
        if log is not None:
            log(theta, gradient)
        mean, square = 0.9 * mean + 0.1 * gradient, 0.99 * square + 0.01 * gradient**2
        theta = theta - 0.03 * mean / (1 - 0.9 ** (i + 1)) / (np.sqrt(square / (1 - 0.99 ** (i + 1))) + 1e-9)
    return log, theta


@pytest.mark.parametrize("seed", range(2))
def test_a_sound_loop_is_silent(seed):
    log, _ = adam(True, seed, updates=200)
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
    log, _ = adam(True, updates=260, fault="detached", at=200)
    iteration, reason = log.first
    assert iteration == 200
    assert reason in FAULTS
    assert f"iteration 200 on ({reason}" in str(log)


def test_a_step_that_becomes_unstable_is_named():
    log, _ = adam(True, updates=240, fault="unstable", at=200)
    assert log.first == (200, "explodes")


def test_theta_and_random_numbers_are_those_without_the_log():
    def cost(theta):
        return float(theta @ theta) + 0.0 * np.random.random() + 0.0 * random.random()  # noqa: NPY002

    before = random.getstate(), np.random.get_state()  # noqa: NPY002
    log = bench.watch(cost, every=1, share=math.inf)
    log(np.ones(3), 2 * np.ones(3))
    np.testing.assert_equal((random.getstate(), np.random.get_state()), before)  # noqa: NPY002
    assert np.array_equal(*(adam(is_watched, updates=60)[1] for is_watched in (False, True)))


def test_the_share_of_time_limits_the_checks(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def cost(theta):
        now[0] += 1.0
        return float(theta @ theta)

    log = bench.watch(cost, every=1, share=0.1)
    for _ in range(1000):
        log(np.ones(2), 2 * np.ones(2))
        now[0] += 10.0
    log(np.ones(2), 1e3 * np.ones(2))
    assert log.first == (1000, "explodes"), "the norm needs no check"
    spent = sum(row["seconds"] for row in log.rows[1:])
    assert 0.05 * (now[0] - log.rows[0]["seconds"]) < spent <= 0.1 * (now[0] - log.rows[0]["seconds"])


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
    assert "2 not: UserError: the cost cannot be called at theta: KeyError: 'missing'" in str(log)
    assert str(log).endswith("nothing is known of the gradient")
    with (tmp_path / "log.csv").open() as file:
        assert [row["iteration"] for row in csv.DictReader(file)] == ["0", "1"]


def test_a_chart_is_drawn(tmp_path):
    log, _ = adam(True, updates=40, fault="detached", at=20)
    assert log.draw(tmp_path / "log.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("given", "word"), [({"cost": 1}, "cost"), ({"every": 0}, "every=0"), ({"share": 0}, "share=0")]
)
def test_bad_input_is_named(given, word):
    with pytest.raises(bench.UserError, match=word):
        bench.watch(**{"cost": abs} | given)


def test_neither_a_theta_that_is_none_nor_a_full_disk_ends_the_loop(tmp_path):
    log = bench.watch(lambda x: float(x @ x), every=2, out=tmp_path / "missing" / "log.csv", share=math.inf)
    for theta in (np.ones(2), "text", np.ones(2), np.ones(2)):
        log(theta, 2 * np.ones(2))
    assert [row["iteration"] for row in log.rows] == [0, 2]
    assert log.first is None
    assert "log.csv" in str(log)
    log(np.array([np.nan, 1.0]), np.ones(2))
    assert log.first == (4, "not_finite")
    (tmp_path / "missing").mkdir()
    for _ in range(2):
        log(np.ones(2), 2 * np.ones(2))
    with (tmp_path / "missing" / "log.csv").open() as file:
        assert [row["iteration"] for row in csv.DictReader(file)] == ["0", "2", "4", "6"]
    assert "log.csv" not in str(log)
