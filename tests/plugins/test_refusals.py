"""What backends and estimators refuse, and the words for it."""

import pytest

from bench.experiment.by_name import make
from bench.host.identity import parse_identity
from bench.model import Decision, MechanicalScene, compose, registry

BACKENDS = [
    ("mujoco", "pushing softplus", "replaces penalty, not softplus"),
    ("mujoco", "pendulum penalty rk4", "not rk4"),
    ("mujoco", "double_pendulum", "no MJCF twin"),
    ("mujoco", "wall_penalty_1d", "supports damping_mode=clipped only"),
    ("mujoco", "tossed_box", None),
    ("mujoco[dtype=float32]", "pushing penalty[damping_mode=clipped]", "double precision"),
    (
        "mjx[mode=reverse,iterations=2,derivative=unrolled]",
        "pushing penalty[damping_mode=clipped]",
        "use derivative=implicit, mode=",
    ),
    ("mjx[cone=elliptic]", "tossed_box", "NaN"),
    ("mjx[cone=elliptic,iterations=9,derivative=unrolled]", "tossed_box", "use derivative=implicit and"),
    (
        "mjx[cone=elliptic,iterations=9]",
        "pushing penalty[damping_mode=clipped]",
        "without friction beside elliptic cones",
    ),
    ("mjx[integrator=rk4]", "pendulum", "not semi_implicit_euler"),
    ("jax", "tossed_box", "tossed_box runs only in physics engines, and backend jax is not one"),
    ("checkpointed[keep=jacobians]", "quadratic", "needs time steps"),
    ("fused", "pushing complementarity", "no root finder"),
    ("fused", "pushing straight_through", "surrogate"),
]
ESTIMATORS = [
    ("boundary", "pushing", None),
    ("boundary", "pushing impulse", "impulse may jump"),
    ("boundary", "ledge penalty semi_implicit_euler height", "its own theta"),
    ("boundary", "billiard straight_through", "straight_through is a surrogate"),
    ("boundary", "hopper_run", "declares no events"),
    ("stochastic_derivative", "heaviside", "declares discrete events"),
    ("stochastic_derivative", "cubic", "declares discrete events"),
    ("stochastic_derivative", "coin_walk", None),
    ("planted[angle=30]", "heaviside", "at least 2 coordinates"),
    ("quadratic_model", "cartpole", "noise on theta"),
    ("total_propagation[per=action]", "pushing", None),
    ("total_propagation[per=action]", "pushing[hold=3]", "noise on the action"),
    ("total_propagation[per=action]", "bouncing_ball", "noise on the action"),
    ("windowed", "pushing penalty semi_implicit_euler mass", "theta must be the scene's own"),
    ("windowed[terminal=exact]", "pendulum", "knows its cost-to-go"),
]
"""Plugin; scene, law, integrator and the parameters that theta names; words of the reason, or None where it is not refused."""


def program(scene, contact="penalty", integrator="semi_implicit_euler", *theta):
    given = make("scenes", scene)
    if not isinstance(given, MechanicalScene):
        return compose(given, decision=Decision(theta))
    law = make("contacts", contact, given.contact_values) if given.n_contacts else None
    return compose(given, law, make("integrators", integrator), Decision(theta))


@pytest.mark.parametrize(("backend", "given", "words"), BACKENDS)
def test_a_backend_says_why_it_refuses_a_program(backend, given, words):
    if reason := registry.find("backends", parse_identity(backend)[0]).reason:
        pytest.skip(reason)
    check(make("backends", backend).refusal(program(*given.split())), words)


@pytest.mark.parametrize(("estimator", "given", "words"), ESTIMATORS)
def test_an_estimator_says_why_it_refuses_a_program(estimator, given, words):
    check(make("estimators", estimator).own_refusal(program(*given.split())), words)


def check(reason, words):
    assert (reason is None) == (words is None)
    assert (words or "") in (reason or "")
