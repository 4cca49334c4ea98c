"""The estimator that plants errors: each has the kind and size that it states."""

import math

import numpy as np
import pytest
from bench.plugins.estimators.planted import Planted
from classes import Quadratic
from dose_response.measure import compare

import bench

UNLIKELY = 1e-4
"""Probability below which a distribution counts as another one."""
D = 20


REPEATS = 4000
SPREAD = 4 * math.sqrt(2 / (D * REPEATS))
"""Four deviations of the mean square of a chi-square with D REPEATS degrees of freedom."""
CASES = [
    *(({"bias": bias}, {"bias": bias, "spread": 0.0}) for bias in (0.1, 0.9)),
    *(
        ({"angle": angle}, {"error": 2 * math.sin(math.radians(angle / 2)), "cosine": math.cos(math.radians(angle))})
        for angle in (30.0, 90.0, 120.0)
    ),
    *(
        (
            {"noise": noise},
            {"spread": pytest.approx(noise, rel=SPREAD), "bias": pytest.approx(0, abs=4 * noise / math.sqrt(REPEATS))},
        )
        for noise in (0.3, 3.0)
    ),
]
"""What is planted, and what is measured: the error of a rotation alone is 2 sin(angle / 2)."""


def estimated(repeats, **planted):
    """Estimates with a planted error, and the exact gradient."""
    problem = bench.problem(Quadratic(dimension=D, condition=5.0), backend="numpy")
    theta = problem.program.theta0 + 1.0
    noise = np.random.default_rng(0).standard_normal((repeats, 4, D))
    return Planted(base="best", **planted).estimate(problem, theta, noise), problem.grad(theta, np.zeros((D, 1)))[:, 0]


@pytest.mark.parametrize(("planted", "expected"), CASES, ids=str)
def test_a_planted_error_has_its_kind_and_size(planted, expected):
    found = compare(*estimated(REPEATS, **planted), 0.0)
    for name, value in expected.items():
        # the numpy backend's gradients are differences
        assert found[name] == (pytest.approx(value, rel=1e-7, abs=1e-7) if isinstance(value, float) else value)
