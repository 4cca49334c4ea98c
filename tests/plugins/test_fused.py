"""The fused backend: the same numbers as JAX, ties and NaN included, from code that is compiled once per structure."""

import math
import re
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from classes import Quadratic

import bench
from bench.model import Compilations, FunctionScene, compose, param, registry

pytest.importorskip("numba")

from bench.plugins.backends.fused import _source
from bench.plugins.fused import functions, kernels

SAME = 1e-12
"""Relative difference allowed from JAX, which adds the same terms in another order."""


@dataclass(frozen=True)
class Kinks(FunctionScene):
    """Operations with ties, each on a coordinate of its own, and an angle."""

    name = "fused_kinks"
    neglected_effects: ClassVar[str] = "everything but kinks"
    sigma: float = param(1e-3, "noise", positive=True)
    scale: float = param(2.0, "a parameter")

    def theta0(self):
        """Return the kinks themselves, and an angle of 1."""
        return np.array([0.0, 0.0, 0.0, 1.0])

    def cost(self, xp, x):
        """Return |x0| + max(x1, 0) + (x2 where positive) + scale sin x3, and 0 times 1 / x0."""
        kept = xp.where(x[2] > 0, x[2], 0.0 * x[2])
        return xp.abs(x[0]) + xp.maximum(x[1], 0.0 * x[1]) + kept + self.scale * xp.sin(x[3]) + 0.0 / x[0]


@dataclass(frozen=True)
class Sorted(Kinks):
    """A cost that has no form as scalar code."""

    name = "fused_sorted"

    def cost(self, xp, x):
        """Return the largest coordinate, found by sorting."""
        return xp.sort(x, axis=0)[-1]


def relative(a, b):
    assert np.array_equal(np.isnan(a), np.isnan(b))
    return np.nanmax(np.abs(a - b)) / np.nanmax(np.abs(b))


@pytest.fixture(scope="module")
def kinks():
    return [registry.make("backends", name).compile(compose(Kinks())) for name in ("fused", "jax")]


@pytest.fixture(scope="module")
def pushing():
    return [bench.problem("pushing[horizon=3]", backend=name) for name in ("fused", "jax")]


@pytest.mark.slow
def test_ties_and_nan_are_those_of_jax(kinks):
    fused, jax = kinks
    theta = np.array([[0.0, 0.5, 0.25], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, -2.0, 40.0]])
    w = np.zeros((4, 3))
    assert relative(fused.grad(theta, w), jax.grad(theta, w)) < SAME
    assert np.isnan(fused.value(theta, w)).tolist() == [True, False, False]
    # an angle beyond the range of the fast sine is computed by the C library
    theta = np.array([[1.0], [1.0], [1.0], [1e9 + 0.5]])
    assert fused.value(theta, np.zeros((4, 1)))[0] == pytest.approx(3.0 + 2.0 * math.sin(1e9 + 0.5), rel=SAME)


@pytest.mark.parametrize(("dtype", "huge"), [("float64", 1e200), pytest.param("float32", 1e25, marks=pytest.mark.slow)])
def test_a_cost_that_overflows_has_no_gradient_finite_as_its_slope_may_be(pushing, dtype, huge):
    """In float32 the slope of such a cost once came out as a number."""
    program = pushing[0].program
    theta = np.array([[1.0, huge, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, -huge]])
    for name in ("fused", "jax"):
        problem = registry.make("backends", name, {"dtype": dtype}).compile(program)
        lost = np.isnan(problem.grad(theta, np.zeros((3, 3))))
        assert lost.tolist() == [[False, True, True]] * 3, name


def test_what_is_remembered_of_a_block_begins_at_zero_without_a_loop_over_time_too():
    """Without carries nothing was stored before the passes, and the mark of large slopes was whatever lay in memory."""
    text = _source(compose(Quadratic()), "grad", "float64").text
    place = re.search(r"lane\[(\d+) \+ l\] = lane\[\1 \+ l\] if abs", text)
    assert place
    assert f"lane[{place[1]} + l] = F(0.0)" in text


@pytest.mark.parametrize("horizon", [5, 10_000])
def test_parameters_and_horizon_compile_nothing_again(pushing, horizon):
    """Controls of each step are data: a rollout of 10,000 was refused as code that is too long."""
    fused, _ = pushing
    w = np.zeros((3, 32))
    fused.grad(fused.program.theta0, w)
    changed, jax = (
        bench.problem(f"pushing[horizon={horizon},mass=0.3]", "penalty[stiffness=77]", backend=name)
        for name in ("fused", "jax")
    )
    other = changed.program
    w = np.random.default_rng(1).standard_normal((horizon, 40))
    changed.compilations = Compilations()
    assert relative(changed.grad(other.theta0, w), jax.grad(other.theta0, w)) < SAME
    assert changed.compilations.made == 0


def test_machine_code_is_kept_on_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "_known", {})
    fused = bench.problem("linear[dimension=2]", backend="fused")
    fused.compilations = Compilations(tmp_path)
    first = fused.value(np.ones(2), np.zeros((2, 1)))
    assert fused.compilations.made == 1
    monkeypatch.setattr(kernels, "_known", {})
    assert fused.value(np.ones(2), np.zeros((2, 1))) == first
    assert fused.compilations.made == 1, "loaded, not compiled"


def test_an_operation_without_scalar_form_is_refused_by_name():
    backend = registry.make("backends", "fused")
    assert "no scalar code for sort" in str(backend.own_refusal(compose(Sorted())))


def test_sine_and_cosine_are_accurate_in_the_whole_range():
    """The text of the fast functions, run by Python, against the C library: within 2 units in the last place of 1."""
    scope = {"np": np, "math": math, "F": float, "njit": lambda **options: lambda function: function}
    exec(functions.FAST, scope)
    rng = np.random.default_rng(0)
    angles = np.concatenate([rng.uniform(-s, s, 300) for s in (1e-3, 1.0, 30.0, 1e4, functions.LIMIT)])
    angles = np.concatenate([angles, np.arange(-40, 40) * math.pi / 2, [0.0]])
    for name in ("sin", "cos"):
        off = [abs(scope[f"{name}_"](float(x)) - getattr(math, name)(x)) for x in angles]
        assert max(off) < 2 * np.finfo(float).eps
    with np.errstate(invalid="ignore"):
        assert math.isnan(scope["sin_"](math.nan))
        assert math.isnan(scope["cos_"](math.inf))
