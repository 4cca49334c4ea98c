"""No hint softens a verdict about theta: every planted fault, with and without refined=, sigma=, noise= and expect=."""

import dataclasses
import sys

import numpy as np
import pytest

import bench
from bench.examine.text import derivative_facts
from bench.gradient.rules import RULES

START = np.array([0.5, -1.0, 8.0])
RANK = {"right": 0, "not shown": 1, "wrong": 2}
DAMPING = 0.4
DAMPERS = 0.0125, 0.03, 0.06, 0.125, 0.3, 0.6, 1.25
"""Sizes from under a thousandth to a twelfth of the critical damping."""


def ball(x, w=None, steps=40, held=None):
    """A ball falls on a soft floor: explicit steps of fixed length; theta is height, speed and root of the stiffness.

    ``held`` are damper forces that a detached damper takes from another run.
    """
    q, v, dt, forces = x[0], x[1] + (0.0 if w is None else 0.05 * w[0]), 0.8 / steps, []
    for i in range(steps):
        depth = -q if q.real < 0 else 0.0
        force = 0.0 if q.real >= 0 else DAMPING * v if held is None else held[i]
        forces.append(force)
        v = v + dt * (-9.81 + x[2] * x[2] * depth - force)
        q = q + dt * v
    return (q - 0.3) ** 2 + 0.1 * v * v, forces


def cost(x, w=None):
    return ball(x, w)[0]


def refined(x, w=None):
    return ball(x, w, steps=400)[0]


def slope(x, w=None, is_detached=False):
    held = [force.real for force in ball(x, w)[1]] if is_detached else None
    return np.array([ball(row, w, held=held)[0].imag for row in np.asarray(x) + 1e-30j * np.eye(3)]) / 1e-30


FAULTS = {
    "a factor of .96": lambda x, w=None: 0.96 * slope(x, w),
    "a factor of 1.04": lambda x, w=None: 1.04 * slope(x, w),
    # more like the gradient of the refined cost, of which it is no derivative either
    "a factor of .9": lambda x, w=None: 0.9 * slope(x, w),
    "a sign": lambda x, w=None: -slope(x, w),
    "one component": lambda x, w=None: slope(x, w) * [1.0, 1.03, 1.0],
    "a detached damper": lambda x, w=None: slope(x, w, is_detached=True),
    "zeros": lambda x, w=None: 0.0 * slope(x, w),
    "no number": lambda x, w=None: np.nan * slope(x, w),
    "another theta": lambda x, w=None: slope(START, w),
    "no normalisation": lambda x, w=None: slope(x, w) + 0.05 * np.asarray(x),
}
HINTS = {
    "refined": {"refined": refined},
    "small sigma": {"sigma": [0.01]},
    "two sigmas": {"sigma": [0.01, 0.1]},
    "noise": {"noise": 1},
    "everything": {"refined": refined, "sigma": [0.01, 0.1], "noise": 1, "expect": "adaptive"},
}


def examined(grad, **hints):
    # under own noise a gradient is judged by its mean, over 256 draws or more
    calls = 12_000 if "noise" in hints else 1500
    return bench.examine(cost, START, grad=grad, calls=calls, progress=False, **hints)


@pytest.mark.parametrize(
    ("fault", "damping"),
    [
        *(pytest.param(f, DAMPING, marks=[pytest.mark.slow] * (i % 4 > 0)) for i, f in enumerate(FAULTS)),
        *(pytest.param("a detached damper", size, marks=pytest.mark.slow) for size in DAMPERS),
    ],
)
def test_no_hint_softens_a_verdict(fault, damping, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "DAMPING", damping)
    plain = examined(FAULTS[fault])
    assert (plain.status, plain.derivative) == (1, "wrong"), str(plain)
    assert {dataclasses.replace(plain, expect=cause).status for cause in RULES} == {1}
    for name, hints in HINTS.items():
        report = examined(FAULTS[fault], **hints)
        assert RANK[report.derivative] >= RANK[plain.derivative], f"{name}\n{report}"
        assert report.status == 1, f"{name}\n{report}"
        assert report.cause != "adaptive"


@pytest.mark.slow
def test_the_right_gradient_of_the_same_program_passes_with_every_hint():
    for name, hints in {"none": {}, **HINTS}.items():
        report = examined(slope, **hints)
        assert report.derivative == "right", f"{name}\n{report}"


def rounded(x, w=None):
    return np.sum(np.round(8.0 * np.asarray(x)) / 8.0)


@pytest.mark.slow
def test_a_straight_through_estimator_is_wrong_at_theta_and_usable_under_noise():
    report = bench.examine(rounded, [0.3, 0.7], grad=lambda x: np.ones(2), sigma=0.5, calls=12_000, progress=False)
    assert report.derivative == "wrong"
    assert "usable. The bias" in report.noise_answer
    assert (report.status, report.noise_cause) == (1, "")


def test_a_rounded_latent_moves_the_cost_under_noise():
    """For each draw the cost is flat, and the mean over draws is not."""

    def latent(x, w):
        return float(np.mean(np.round(x[0] + w)) ** 2)

    report = bench.examine(latent, [0.3], grad=lambda x, w: [0.0], sigma=0.3, noise=20, calls=8000, progress=False)
    assert "does theta reach the simulator" not in str(report)
    assert (report.status, report.noise_cause) == (1, "staircase"), str(report)
    assert any(text.startswith("biased") for text in report.problems)


def test_draws_that_do_not_move_the_cost_show_no_gradient_under_noise():
    """The jump is 300 standard deviations away: grad J is 0 with an error of 0, of which no bias is known."""
    report = bench.examine(
        lambda x: 1.0 * (x[0] > 30), [0.0], grad=lambda x: [0.0], sigma=0.1, calls=4000, progress=False
    )
    assert (report.status, report.derivative, report.use) == (3, "not shown", "not shown")
    assert "no draw moves the cost" in report.noise_answer


def spring(x, steps=50):
    q, v = 1.0 + 0.0 * x[0], 0.0 * x[0]
    for _ in range(steps):
        v = v - 0.02 * (x[0] * q + x[1] * v)
        q = q + 0.02 * v
    return q * q


def spring_slope(x, steps=50):
    return np.array([spring(row, steps).imag for row in np.asarray(x) + 1e-30j * np.eye(2)]) / 1e-30


@pytest.mark.parametrize(
    ("is_wrong", "cause"), [(lambda n: n > 100, "overwritten"), (lambda n: n < 50, "missing_term")]
)
def test_a_gradient_that_is_wrong_at_one_of_the_horizons_is_wrong(is_wrong, cause):
    def grad(x, steps=50):
        return spring_slope(x, steps) * (1.01 if is_wrong(steps) else 1.0)

    said = bench.examine(spring, [0.7, 1.2], grad=grad, horizons=(1, 5, 50, 200), calls=5000)
    assert (said.status, said.cause) == (1, cause)
    assert "steps off by 1" in str(said)


def test_an_error_of_a_third_of_a_percent_shows_in_single_precision():
    def cost(x):
        return np.float32(x[1]) * np.float32(x[0]) ** 2

    for factor, status in ((1.0, 0), (1.003, 1)):
        said = bench.examine(cost, [1.5, 0.7], grad=lambda x, f=factor: [2 * x[0] * x[1] * f, x[0] ** 2], calls=5000)
        assert said.status == status, said
        assert "errors below about 0.1%" in str(said)


def test_a_steep_smooth_cost_has_no_jumps():
    def cost(x):
        return np.tanh((x[0] - 1.003) / 1e-4) + 0.1 * x[0]

    def grad(x):
        return [(1.0 - np.tanh((x[0] - 1.003) / 1e-4) ** 2) / 1e-4 + 0.1]

    said = bench.examine(cost, [1.0], grad=grad, sigma=0.01, calls=6000)
    assert said.noise_cause in ("", "spread"), said
    assert said.derivative == "right"


@pytest.mark.parametrize("slope", [2e-8, 2e-7])
def test_a_slope_below_the_rounding_of_the_cost_is_not_shown_to_be_zero(slope):
    said = bench.examine(lambda x: 1e6 + slope * x[0], [1.0], grad=lambda x: [0.0], calls=4000)
    assert (said.status, said.cause) == (3, "unresolved"), said


def test_stairs_say_nothing_about_noise_that_was_not_measured():
    table = np.sin(np.linspace(0.0, 2.0, 41))
    said = bench.examine(
        lambda x: table[round(float(x[0]) / 0.05)], [0.777], grad=lambda x: [np.cos(x[0])], sigma=0.1, calls=700
    )
    assert said.use == "not measured", said


def test_a_check_that_is_not_finished_names_no_error_after_other_steps():
    said = bench.examine(spring, [0.7, 1.2], grad=spring_slope, horizons=(1, 5), calls=3000)
    unfinished = dataclasses.replace(said, is_complete=False)
    assert unfinished.derivative_cause == "undecided"
    assert derivative_facts(unfinished) == ["2 of 2 components"]
