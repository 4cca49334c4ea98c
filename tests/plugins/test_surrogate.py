"""Laws with the motion of one law and the gradient of another, and words for it wherever it is shown."""

import numpy as np
import pytest
from classes import (
    Billiard,
    BounceOnce,
    Complementarity,
    Fobg,
    Implicit,
    Jax,
    Numpy,
    Penalty,
    SemiImplicitEuler,
    StraightThrough,
    SurrogateBackward,
    Torch,
)

from bench.measure.reference import certify
from bench.model import compose

U = np.linspace(-50, 50, 100)[None]
STILL = np.zeros_like(U)


@pytest.fixture(scope="module")
def problems():
    laws = {"hard": Penalty(), "surrogate": StraightThrough(beta=50.0), "none": StraightThrough(backward="none")}
    laws["same"] = StraightThrough(backward="penalty")
    # ten times faster than the source's shot, so that a dozen steps are enough
    scene = Billiard(horizon=12, push=40.0, start=10.0)
    return {name: Torch().compile(compose(scene, law, SemiImplicitEuler())) for name, law in laws.items()}


def test_the_motion_is_the_forward_laws(problems):
    hard = problems["hard"].value(U, STILL)
    for name in ("surrogate", "none", "same"):
        np.testing.assert_array_equal(problems[name].value(U, STILL), hard)


def test_missed_balls_have_no_gradient_except_with_contacts_from_distance(problems):
    hard, distant = (problems[name].grad(U, STILL)[0] for name in ("hard", "surrogate"))
    missed = np.abs(U[0]) > 22.5
    assert (hard[missed] == 0).all()
    assert (distant != 0).all()


def test_the_same_law_behind_gives_the_derivative(problems):
    np.testing.assert_allclose(problems["same"].grad(U, STILL), problems["hard"].grad(U, STILL), rtol=1e-12, atol=1e-15)


@pytest.mark.slow
def test_a_surrogate_gradient_certifies_nothing(problems):
    assert problems["surrogate"].program.surrogate
    reference = certify(problems["surrogate"], Torch().provides, 16, 0.05)
    assert "first_order" not in reference.method


def test_differences_cannot_give_a_surrogate_which_is_never_declared_unbiased():
    program = compose(Billiard(horizon=5), StraightThrough(), SemiImplicitEuler())
    assert "surrogate" in Fobg().refusal(program, Numpy().provides, "numpy")
    assert Fobg().refusal(program, Jax().provides, "jax") is None
    assert not Fobg().declares_unbiased(program)


NEAR = np.array([[0.101, 0.1001, 0.12], [-2.0, -1.0, 0.0], [0.0, 0.0, 0.0]])
"""Heights, velocities and forces of balls of radius 0.1 that hit the ground in one step, nearly hit it, or miss it."""


def ball(law, horizon=1):
    return Implicit().compile(compose(BounceOnce(horizon=horizon), law, SemiImplicitEuler()))


@pytest.mark.slow
def test_a_rigid_motion_is_that_of_its_kappa_and_one_step_has_the_derivative_of_the_softer_kappa():
    """After one step the cost is linear in the state, so its gradient is the step's derivative."""
    law, still = SurrogateBackward(kappa=1e-7, soft_kappa=0.1), np.zeros((3, 3))
    surrogate, hard, soft = (ball(law) for law in (law, Complementarity(kappa=1e-7), Complementarity(kappa=0.1)))
    np.testing.assert_allclose(surrogate.value(NEAR, still), hard.value(NEAR, still), rtol=1e-12)  # compiled anew
    found, expected, other = (problem.grad(NEAR, still) for problem in (surrogate, soft, hard))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    assert (np.abs(found - other)[0] > 0.01).any()
    wrong = ball(SurrogateBackward(kappa=1e-7, soft_kappa=0.105)).grad(NEAR, still)
    assert np.abs(wrong - expected).max() > 1e-3  # an error of 5% in kappa is seen
