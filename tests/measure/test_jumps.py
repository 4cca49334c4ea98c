"""The jump search of the gradient check: what the noise reaches, which gradients at theta do not show."""

import math

import numpy as np
import pytest
import trusted
from bench.plugins.backends.numpy import Numpy

from bench.measure.jumps import jump_under_noise, largest_jump
from bench.model import compose

SEEN = {(s.family, s.label): s for s in trusted.scenes()}


def puck(at):
    """A puck with viscous drag slides along a table that ends at ``at`` metres; the cost there is 1 higher."""

    def cost(xp, v0):
        x, v = 0.0 * v0[0], v0[0]
        for _ in range(100):
            v = v - 0.01 * v
            x = x + 0.01 * v
        return (x - 2.0) ** 2 + xp.where(x > at, 1.0, 0.0)

    return trusted.Scene("", "puck", f"edge at {at}", cost, (2.0,), 0.2)


def search(scene):
    problem = Numpy().compile(compose(trusted.Given(scene.label, scene.cost, scene.theta, scene.sigma)))
    return jump_under_noise(problem, np.array(scene.theta), 0, trusted.COLUMNS)


@pytest.mark.parametrize("at", [1.4, 1.2])
def test_an_edge_that_the_noise_reaches_is_found(at):
    """First order spreads by 1.5% of its mean there, and its bias is 11 or 2 times the gradient."""
    scene = puck(at)
    jump, w = search(scene)
    assert jump.height == pytest.approx(1.0, rel=1e-6)
    slope = 0.99 * (1.0 - 0.99**100)
    assert (2.0 + 0.2 * w[0]) * slope == pytest.approx(at, abs=1e-6)


@pytest.mark.parametrize("name", [key for key in SEEN if key[0] in ("flight", "saturation")], ids=str)
def test_a_continuous_cost_has_no_jump(name):
    assert search(SEEN[name])[0].height == 0.0


FAR = "[1.9, 2.5, 5.0]"
"""A gate 4.2 standard deviations away."""


@pytest.mark.parametrize("name", [key for key in SEEN if key[0] in ("gate", "edge") and key[1] != FAR], ids=str)
def test_a_jump_within_reach_is_found(name):
    jump, w = search(SEEN[name])
    assert jump.height > 0.0
    assert math.isfinite(jump.span)
    assert 0.0 < np.abs(w).max() <= 4.0


def test_points_with_many_coordinates_are_made_in_parts(monkeypatch):
    starts, ends = np.full((50, 3), -1.0), np.ones((50, 3))
    ends[0] = [1.0, 2.0, 3.0]
    sizes = []

    def cost(x):
        sizes.append(x.size)
        return np.where(x[0] > 1.5, 1.0, 0.0) + x.sum(axis=0) ** 2

    whole = largest_jump(cost, starts, ends)
    monkeypatch.setattr("bench.measure.jumps.MOST_POINTS", 500)
    sizes.clear()
    assert largest_jump(cost, starts, ends) == whole
    assert whole.height == pytest.approx(1.0, abs=1e-3)
    assert max(sizes) <= 500
