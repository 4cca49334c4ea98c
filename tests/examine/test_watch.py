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
    assert [row["iteration"] for row in log.rows] == list(range(0, 200, 20))


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
    assert log.rows[10]["gradient_norm"] > 200 * max(row["gradient_norm"] for row in log.rows[:10])


def test_theta_and_random_numbers_are_those_without_the_log():
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    first = adam(False, updates=60)[1], random.random(), np.random.random()  # noqa: NPY002
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002

    def cost(theta):
        return float(theta @ theta) + 0.0 * np.random.random() + 0.0 * random.random()  # noqa: NPY002

    log = bench.watch(cost, every=1, share=math.inf)
    log(np.ones(3), 2 * np.ones(3))
    second = adam(True, updates=60)[1], random.random(), np.random.random()  # noqa: NPY002
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


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
    spent = sum(row["seconds"] for row in log.rows[1:])
    assert 0.05 * (now[0] - log.rows[0]["seconds"]) < spent <= 0.1 * (now[0] - log.rows[0]["seconds"])


def test_noise_of_the_loop_is_held_in_a_check_and_structures_are_accepted():
    data, log = (
        np.random.default_rng(0).normal(size=64),
        bench.watch(
            lambda p, w: float(((p["slope"] * data[w.astype(int)] + p["bias"]) ** 2).mean()), every=1, share=math.inf
        ),
    )
    for factor in (1.0, 1.0, 2.0):
        batch, p = np.random.default_rng(1).integers(64, size=8), {"slope": 0.5, "bias": np.ones(1)}
        rest = factor * 2 * (p["slope"] * data[batch] + p["bias"])
        log(p, {"slope": (rest * data[batch]).mean(), "bias": np.array([rest.mean()])}, batch)
    assert [row["reason"] for row in log.rows] == [""] * 3
    assert log.first[0] == 2


@pytest.mark.parametrize(
    ("gradient", "reason"), [(np.array([math.nan, 1.0]), "nan_gradient"), (np.array([2.0, -2.0]), "wrong_adjoint")]
)
def test_wrong_numbers_are_named(gradient, reason):
    log = bench.watch(lambda x: float(x @ x), every=1, share=math.inf)
    log(np.ones(2), gradient)
    assert log.first == (0, reason)


def test_a_failing_cost_does_not_end_the_loop(tmp_path):
    log = bench.watch(lambda x: {}["missing"], every=1, out=tmp_path / "log.csv", share=math.inf)
    log(np.ones(2), np.ones(2))
    log(np.ones(2), np.ones(3))
    assert log.first is None
    assert "2 not" in str(log)
    assert "missing" in str(log)
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
