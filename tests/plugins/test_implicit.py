"""The implicit backend's root finder: the columns of a batch are solved independently."""

import numpy as np
import pytest
from classes import (
    BounceOnce,
    Cubic,
    Implicit,
    ImplicitEuler,
    Numpy,
    Penalty,
)

from bench.model import compose

SOLVED = 1e-12
"""The root finder stops at a relative change of 1e-12, and Newton's last step on a linear equation is exact."""


@pytest.mark.parametrize("unknowns", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_columns_of_any_scale_are_differentiated_alike(unknowns):
    """z = 1 / a has the derivative -1 / a^2, whatever the a of other columns."""
    import jax
    import jax.numpy as jnp

    ops = Implicit().ops()
    a = jnp.asarray([1e-12, 1.0, 1e12])

    def total(a):
        guess = jnp.stack([2.0 / a] * unknowns)
        return jnp.sum(ops.root(lambda z, a: a * z - 1.0, guess, a))

    assert np.asarray(jax.jit(jax.grad(total))(a)) == pytest.approx(-unknowns / np.asarray(a) ** 2, rel=SOLVED)


def stiff(stiffness, **values):
    """A ball on a spring so stiff that dt^2 k / m is ``stiffness``, all along the 10 steps before, at and after touch."""
    scene = BounceOnce(horizon=10, height=0.1 + 5.3 * 2.0 / 480.0, **values)
    return Implicit().compile(compose(scene, Penalty(stiffness=stiffness / scene.dt**2), ImplicitEuler()))


@pytest.mark.parametrize("stiffness", [1e2, 1e8, 1e11])
def test_stiff_equations_are_solved_whatever_the_size_of_their_residual(stiffness):
    """A residual that multiplies the gap by 1e11 rounds to 1e-5, which is no failure."""
    problem = stiff(stiffness)
    w = 0.1 * np.random.default_rng(0).standard_normal((problem.program.n_noise, 64))
    theta = problem.program.theta0
    assert np.isfinite(problem.value(theta, w)).all()
    assert np.isfinite(problem.grad(theta, w)).all()


@pytest.mark.parametrize("mode", ["reverse", pytest.param("forward", marks=pytest.mark.slow)])
def test_a_solve_that_fails_has_no_gradient(mode):
    """z^2 + 1 = 0 has no root; what the last iteration left has a derivative all the same, of nothing."""
    import jax
    import jax.numpy as jnp

    ops = Implicit().ops()
    a = jnp.asarray([[-1.0, 1.0]])

    @jax.jit
    def root(a):
        return ops.root(lambda z, a: z * z + a, 2.0 + 0.0 * a, a)

    assert np.isnan(np.asarray(root(a))).tolist() == [[False, True]]
    by = {
        "reverse": jax.grad(lambda a: root(a).sum()),
        "forward": lambda a: jax.jvp(root, (a,), (jnp.ones_like(a),))[1],
    }
    slope = jax.jit(by[mode])(a)
    assert np.isnan(np.asarray(slope)).tolist() == [[False, True]]
    assert slope[0, 0] == pytest.approx(-0.5, rel=SOLVED)


def test_complex_numbers_are_an_error(monkeypatch):
    from bench.plugins.backends.numpy import NumpyProblem

    problem = Numpy().compile(compose(Cubic(dimension=1)))
    monkeypatch.setattr(NumpyProblem, "_grad", lambda self, theta, w: np.ones((1, w.shape[1])) + 1j)
    with pytest.raises(TypeError, match="complex"):
        problem.grad(np.array([1.0]), np.zeros((1, 2)))
