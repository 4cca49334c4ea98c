"""No hint softens a verdict about theta: every planted fault, with and without refined=, sigma=, noise= and expect=."""

import dataclasses
import sys
from functools import partial

import numpy as np
import pytest
from mechanisms import swinging

import bench
from bench.gradient.rules import RULES

START = np.array([0.5, -1.0, 8.0])
RANK = {"right": 0, "not shown": 1, "wrong": 2}
DAMPING = 0.4
DAMPERS = 0.0125, 0.03, 0.06, 0.125, 0.3, 0.6, 1.25
"""Sizes from under a thousandth to a twelfth of the critical damping."""


def ball(x, w=None, steps=20, held=None):
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
    return ball(x, w, steps=200)[0]


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
    calls = 12_000 if "noise" in hints else 1000
    return bench.examine(cost, START, grad=grad, calls=calls, progress=False, **hints)


@pytest.mark.parametrize(
    ("fault", "damping"),
    [
        *((f, DAMPING) for f in FAULTS),
        *(pytest.param("a detached damper", size, marks=pytest.mark.slow) for size in DAMPERS),
    ],
)
def test_no_hint_softens_a_verdict(fault, damping, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "DAMPING", damping)
    plain = examined(FAULTS[fault])
    assert (plain.status, plain.derivative) == (1, "wrong"), str(plain)
    assert {dataclasses.replace(plain, expect=cause).status for cause in RULES} == {1}
    # a design: each fault with one hint
    name, hints = list(HINTS.items())[[*FAULTS].index(fault) % len(HINTS)]
    report = examined(FAULTS[fault], **hints)
    assert (report.status, RANK[report.derivative]) == (1, RANK["wrong"]), f"{name}\n{report}"
    assert report.cause != "adaptive"


@pytest.mark.slow
def test_the_right_gradient_of_the_same_program_passes_with_every_hint():
    for name, hints in {"none": {}, **HINTS}.items():
        report = examined(slope, **hints)
        assert report.derivative == "right", f"{name}\n{report}"


def test_stairs_say_nothing_about_noise_that_was_not_measured():
    table = np.sin(np.linspace(0.0, 2.0, 41))
    said = bench.examine(
        lambda x: table[round(float(x[0]) / 0.05)], [0.777], grad=lambda x: [np.cos(x[0])], sigma=0.1, calls=700
    )
    assert said.use == "not measured", said


def test_a_check_that_is_not_finished_names_no_error_after_other_steps():
    grad = partial(swinging, slope=True)
    unfinished = dataclasses.replace(
        bench.examine(swinging, [0.7, 1.2], grad=grad, horizons=(1, 5), calls=1000), is_complete=False
    )
    assert unfinished.derivative_cause == "undecided"
    assert unfinished.fact == "2 of 2 components"
