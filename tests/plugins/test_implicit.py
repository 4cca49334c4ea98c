"""The implicit backend's root finder: the columns of a batch are solved independently."""

import numpy as np
import pytest
from bench.plugins.backends.implicit import Implicit
from bench.plugins.contacts.complementarity import Complementarity
from bench.plugins.integrators.semi_implicit_euler import SemiImplicitEuler
from bench.plugins.scenes.ground_wall import GroundWall
from bench.plugins.scenes.pushing import Pushing

from bench.model import compose

SOLVED = 1e-12
"""The root finder stops at a relative change of 1e-12, and Newton's last step on a linear equation is exact."""
SCENES = [pytest.param(Pushing(horizon=5), id="one unknown"), pytest.param(GroundWall(horizon=5), id="two unknowns")]


@pytest.mark.parametrize("scene", SCENES)
def test_a_column_that_cannot_be_solved_is_the_only_one_lost(scene):
    """Noise of 1e160 squares to infinity in the law's equation."""
    problem = Implicit().compile(compose(scene, Complementarity(), SemiImplicitEuler()))
    w = np.random.default_rng(0).standard_normal((problem.program.n_noise, 6))
    lost = np.arange(6) == 2
    broken = np.where(lost, 1e160, w)
    for function in (problem.value, problem.grad):
        whole, part = function(scene.theta0(), w), function(scene.theta0(), broken)
        assert not np.isfinite(part[..., lost]).any()
        assert np.array_equal(part[..., ~lost], whole[..., ~lost])


@pytest.mark.parametrize("unknowns", [1, 2])
def test_columns_of_any_scale_are_differentiated_alike(unknowns):
    """z = 1 / a has the derivative -1 / a^2, whatever the a of other columns."""
    import jax
    import jax.numpy as jnp

    ops = Implicit().ops()
    a = jnp.asarray([1e-12, 1.0, 1e12])

    def total(a):
        guess = jnp.stack([2.0 / a] * unknowns)
        return jnp.sum(ops.root(lambda z, a: a * z - 1.0, guess, a))

    assert np.asarray(jax.grad(total)(a)) == pytest.approx(-unknowns / np.asarray(a) ** 2, rel=SOLVED)
