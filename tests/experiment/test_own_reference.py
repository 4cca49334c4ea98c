"""A reference serves another backend only where both compute the same costs; else the backend has its own."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from helpers import loaded

from bench.experiment.session import Problems
from bench.measure.reference import LEAST_SAMPLES, Reference, transferred
from bench.model import FunctionScene, compose, param, registry
from bench.run.references import References


@dataclass(frozen=True)
class Given(FunctionScene):
    """A cost of one number x = theta + sigma w."""

    name = "given"
    theta_names = ("theta",)
    neglected_effects = "dynamics"
    continuous = False

    sigma: float = 1.0
    theta: float = param(0.0, "where the gradient is estimated")


def compiled(function):
    program = compose(type("Of", (Given,), {"cost": lambda self, xp, x: function(xp, x[0])})(), None, None)
    return registry.make("backends", "numpy", {}).compile(program)


def step(at):
    return compiled(lambda xp, x: xp.where(x > at, 1.0 + 0.0 * x, 0.0 * x))


TIED = """
from dataclasses import dataclass
from bench.model import FunctionScene, param

@dataclass(frozen=True)
class Tied(FunctionScene):
    name = "tied"
    theta_names = ("theta",)
    neglected_effects = "dynamics"
    continuous = False
    sigma: float = 0.1
    theta: float = param(0.1, "where the gradient is estimated")

    def cost(self, xp, x):
        path = xp.sum(xp.stack([xp.clip(x[0], -1.0, 0.04)] * 20), axis=0)
        return x[0] ** 2 + xp.where(path > 0.8, 1.0 + 0.0 * path, 0.0 * path)
"""
UNIT = float(np.finfo(np.float64).eps)
SAMPLED = Reference(np.random.default_rng(0).standard_normal((64, 1)) * 0.08, "sampling[n=64]")
"""A reference with a standard error of about 0.01."""


@pytest.mark.parametrize(
    ("mine", "other", "is_same"),
    [
        (step(0.0), step(0.0), True),
        (compiled(lambda xp, x: x * x), compiled(lambda xp, x: x * x * (1 + 1e-9)), True),
        (compiled(lambda xp, x: 0.0 * x + 3.0), compiled(lambda xp, x: 0.0 * x + 3.0), True),
        (step(0.0), step(0.5), False),
        (compiled(lambda xp, x: x), compiled(lambda xp, x: x + xp.where(x > 2.0, math.nan, 0.0)), False),
        (compiled(lambda xp, x: 0.0 * x + 3.0), compiled(lambda xp, x: 0.0 * x + 4.0), False),
    ],
)
def test_costs_decide_whether_a_reference_is_that_of_another_program(mine, other, is_same):
    found = transferred(SAMPLED, mine, other, LEAST_SAMPLES, UNIT)
    assert found is (SAMPLED if is_same else None)


def test_a_small_share_of_draws_that_differ_enters_the_error():
    # an event of 5e-4 of draws at w = 0: it moves costs, and grad J by less than the error of 0.01
    found = transferred(SAMPLED, step(0.0), step(1e-3), LEAST_SAMPLES, UNIT)
    assert "of draws" in found.note
    assert found.error > 0.0
    exact = Reference(np.ones((1, 1)), "quadrature", 1e-9)
    assert transferred(exact, step(0.0), step(1e-3), LEAST_SAMPLES, UNIT) is None


def test_a_sum_that_ties_with_a_threshold_has_a_reference_of_its_own(tmp_path):
    """20 steps of 0.04 meet a threshold at 0.8, where compiled code rounds the sum another way than an eager loop."""
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "tied.py").write_text(TIED)
    words = [f"plugins={tmp_path}", "scenes=[tied]", "estimators=[randomized_smoothing]", "reference.samples=32768"]
    found = {}
    for backend in ("jax", "torch"):
        given, (cell,) = loaded(*words, f"backends=[{backend}]", f"results_dir={tmp_path}")
        references = References(given, Problems())
        truth, problem = references.of(cell), Problems().of(cell.backend, cell)
        w = np.random.default_rng(0).standard_normal((problem.program.n_noise, 1 << 14))
        costs = problem.value(problem.program.theta0, np.concatenate([w, -w], axis=1))
        terms = (costs[: 1 << 14] - costs[1 << 14 :]) * w[0] / (2 * problem.sigma)
        error = math.hypot(truth.known().standard_error, terms.std() / 128)
        assert abs(truth.gradient[0] - terms.mean()) < 4.5 * error
        found[backend] = truth
    assert "so the reference is from torch" in found["torch"].note
    assert found["jax"].note == ""


@pytest.mark.parametrize("points", [1 << 20, 600])
def test_the_points_of_quadrature_are_a_setting(tmp_path, points):
    words = [
        "scenes=[wall_penalty_1d]",
        "contacts=[penalty]",
        "backends=[numpy]",
        "estimators=[fobg]",
        "reference.samples=4096",
    ]
    given, (cell,) = loaded(*words, f"reference.points={points}", f"results_dir={tmp_path}")
    references, used = References(given, Problems()), []
    problem = references._problems.of(cell.reference_backends[0], cell)
    value = problem.value
    problem.value = lambda theta, w: (used.append(w.shape[1]), value(theta, w))[1]
    references.of(cell)
    assert sum(used) < 4 * min(points, 64 * 4096) + 8 * 16384  # all levels, and what a sampled reference takes
    _, (default,) = loaded(*words, f"results_dir={tmp_path}")
    assert (cell.reference_key == default.reference_key) == (points == 1 << 20)
