"""Theta as named parameters of scene and contact law, and theta0 where the user puts it."""

import dataclasses

import numpy as np
import pytest
from classes import (
    BouncingBall,
    Cartpole,
    Complementarity,
    Heaviside,
    Hopper,
    ImplicitEuler,
    Impulse,
    Jax,
    MassSpring,
    Numpy,
    Penalty,
    Pushing,
    Quadratic,
    SemiImplicitEuler,
    Softplus,
    Torch,
)

from bench.conformance import subjects
from bench.errors import UserError
from bench.host.parameters import parameters
from bench.measure.reference import certify
from bench.model import Decision, Rollout, compose

AGREES = 1e-6
"""Relative difference of gradients and differences of the cost; those below are good to about 1e-9."""
STEP = 1e-4
"""Of fourth-order differences, relative to the parameter: truncation 1e-16, rounding 1e-12 of the cost, and too short to
move a contact from one step to the next."""
ROUNDING = 1e-8
"""Of the numpy backend's differences of step 1e-6, relative to the cost: 1e-14 of it over the step, for stiff contacts and
hundreds of steps make that of 1e-16."""
SOLVED = 1e-10
"""Of costs whose steps solve equations to 1e-12 in the unknown."""

SIGMA = 1e-3
CASES = {
    "pushing": (Pushing(sigma=SIGMA), Penalty(stiffness=1e3), ("mass", "stiffness")),
    "pushing at": (Pushing(sigma=SIGMA), Penalty(stiffness=1e3), ("stiffness", "mass"), (700.0, 0.2)),
    "pushing softplus": (Pushing(sigma=SIGMA), Softplus(stiffness=1e3), ("beta", "scene.velocity_factor")),
    "bouncing_ball": (
        BouncingBall(sigma=SIGMA, horizon=100, dt=0.01),
        Impulse(),
        ("restitution", "bouncing_ball.gravity"),
        (0.8, 9.0),
    ),
    "mass_spring": (MassSpring(sigma=SIGMA), None, ("stiffness", "damping"), (50.0, 1.0)),
    "hopper": (Hopper(sigma=SIGMA, horizon=150), Penalty(stiffness=1e4), ("leg_stiffness",)),
    "cartpole": (Cartpole(sigma=SIGMA), None, ("length", "pole_mass")),
    "quadratic": (Quadratic(sigma=SIGMA), None, ("condition",)),
}
"""Scene, law, names of theta, and where."""
BACKENDS = [
    pytest.param(one, id=one.name, marks=[pytest.mark.slow] * (one.name == "fused"))
    for one in subjects.backends()
    if not {"physics", "simulator"} & one.provides
]


def program_of(scene, law, names, at=None):
    integrator = None if isinstance(scene, Quadratic | Heaviside) else SemiImplicitEuler()
    return compose(scene, law, integrator, Decision(names, at))


def rebuilt(parts, names, values):
    """Scene, law and the rest, built anew with the values of the parameters that theta names."""
    parts = list(parts)
    for name, value in zip(names, values, strict=True):
        owner, _, field = name.rpartition(".")
        fits = [
            part is not None and field in parameters(type(part)) and owner in ("", a, part.name)
            for a, part in zip(("scene", "contact"), parts, strict=False)
        ]
        i = fits.index(True)
        parts[i] = dataclasses.replace(parts[i], **{field: float(value)})
    return parts


def cost(program, values):
    """The cost without noise of the scene's own program with the values of the parameters in theta."""
    parts = (program.scene, program.contact, program.integrator)
    plain = compose(*rebuilt(parts, program.decision.names, values))
    return Numpy().compile(plain).value(plain.theta0, np.zeros((plain.n_noise, 1)))[0]


def differences(program, values):
    """Fourth-order central differences of that cost by each parameter, ``(d,)``."""
    slopes = []
    for i, value in enumerate(values):
        h = STEP * abs(value) * np.eye(len(values))[i]
        near, far = (cost(program, values + k * h) - cost(program, values - k * h) for k in (1, 2))
        slopes.append((8 * near - far) / (12 * h[i]))
    return np.array(slopes)


@pytest.mark.parametrize("case", CASES)
def test_gradient_is_that_of_the_cost_by_the_parameters(case):
    check_gradient(case, Numpy())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("case", ["pushing at", "bouncing_ball"])
def test_every_backend_has_the_gradient_by_the_parameters(case, backend):
    check_gradient(case, backend)


def check_gradient(case, backend):
    """Compare costs and gradients of a batch with the cost and its differences of each column's own program."""
    program = program_of(*CASES[case])
    if reason := backend.refusal(program):
        pytest.skip(reason)
    problem, theta = backend.compile(program), program.theta0
    w = np.array([[0.0, 1.0, -0.7], [0.0, 0.4, 1.3]])[: program.dim]
    facts = (program.dim, program.n_noise, program.noise, program.noise_on_theta)
    assert facts == (len(theta), len(theta), "parameter", True)
    costs, gradients = problem.value(theta, w), problem.grad(theta, w)
    for column in range(w.shape[1]):
        values = theta + SIGMA * w[:, column]
        assert costs[column] == pytest.approx(cost(program, values), rel=1e-9)  # the same operations, on other batches
        expected = differences(program, values)
        assert np.all(expected != 0.0)
        rounding = ROUNDING * costs[column] if backend.name == "numpy" else 0.0
        assert np.all(np.abs(gradients[:, column] - expected) <= AGREES * np.abs(expected) + rounding)
    assert problem.score(theta, w) == pytest.approx(w / SIGMA)


SOLVING = {
    "law": (
        Pushing(sigma=SIGMA, horizon=10),
        Complementarity(stiffness=1e3),
        SemiImplicitEuler(),
        ("mass", "stiffness", "kappa"),
    ),
    "integrator": (MassSpring(sigma=SIGMA, horizon=10), None, ImplicitEuler(), ("stiffness", "mass")),
    "two unknowns": (
        Hopper(sigma=SIGMA, horizon=10, drop=0.001),
        Penalty(stiffness=1e3),
        ImplicitEuler(),
        ("stiffness",),
    ),
}
"""Scene, law, integrator and names of theta."""


@pytest.mark.parametrize("backend", [one for one in BACKENDS if "root" in one.values[0].provides])
@pytest.mark.parametrize("case", [pytest.param(n, marks=[pytest.mark.slow] * (n != "law")) for n in SOLVING])
def test_columns_of_a_batch_have_parameters_of_their_own_in_equations(case, backend):
    """A solver that takes columns one by one has to find each column's own parameters."""
    *parts, names = SOLVING[case]
    problem = backend.compile(compose(*parts, Decision(names)))
    theta = problem.program.theta0
    factors = np.array([[0.5, 2.0], [1.5, 0.7], [0.8, 1.6]])
    spread = theta[:, None] * factors[: theta.size]
    costs, gradients = (function(spread, np.zeros(spread.shape)) for function in (problem.value, problem.grad))
    for i, values in enumerate(spread.T):
        single = compose(*rebuilt(parts, names, values))
        own = backend.compile(single).value(single.theta0, np.zeros((single.n_noise, 1)))[0]
        assert costs[i] == pytest.approx(own, rel=SOLVED)
    assert costs[0] != costs[1]
    alone = problem.grad(spread[:, 1], np.zeros((theta.size, 1)))[:, 0]
    assert gradients[:, 1] == pytest.approx(alone, rel=AGREES)


@pytest.mark.parametrize("backend", [Jax(), Torch(), Numpy()], ids=lambda b: b.name)
def test_programs_that_differ_in_values_only_do_not_mix(backend):
    """Compiled programs are shared by structure: another own theta, or another value of a named parameter, is another result."""
    for scene in (Pushing(sigma=SIGMA), Pushing(sigma=SIGMA, push=0.2), Pushing(sigma=SIGMA, mass=0.3)):
        program = program_of(scene, Penalty(), ("mass",))
        found = backend.compile(program).value(program.theta0, np.zeros((1, 1)))[0]
        assert found == pytest.approx(cost(program, program.theta0), rel=1e-12)


# --------------------------------------------------------------------------------------------------------- theta0


def test_theta0_moves_where_gradients_are_taken():
    scene = Quadratic()
    moved = compose(scene, decision=Decision(at=(1.0, 2.0, 3.0, 4.0, 5.0)))
    assert moved.theta0.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert compose(scene).theta0 == pytest.approx(scene.theta0())
    w = np.zeros((5, 1))
    own, there = (Jax().compile(program).grad(program.theta0, w)[:, 0] for program in (compose(scene), moved))
    assert there / own == pytest.approx(moved.theta0 / scene.theta0())


def test_rollout_of_named_parameters_shows_their_states():
    program = program_of(*CASES["mass_spring"])
    plain = compose(dataclasses.replace(program.scene, damping=1.0), None, SemiImplicitEuler())
    named, own = (Numpy().compile(p).trajectory(p.theta0, np.zeros((p.n_noise, 1))).states for p in (program, plain))
    assert isinstance(program, Rollout)
    assert np.array_equal(named, own)


# ---------------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize(
    ("scene", "decision"),
    [(Quadratic(), Decision(("condition",))), (MassSpring(), Decision(at=(0.2, 0.0)))],
    ids=str,
)
def test_what_the_scene_knows_of_its_own_theta_is_not_used(scene, decision):
    integrator = None if isinstance(scene, Quadratic) else SemiImplicitEuler()
    own, other = (compose(scene, None, integrator, choice) for choice in (Decision(), decision))
    assert own.closed_form_gradient() is not None or own.physical_gradient() is not None
    assert other.closed_form_gradient() is None
    assert other.physical_gradient() is None
    assert other.physical_cost() is None


def test_reference_of_named_parameters_is_computed():
    program = program_of(*CASES["quadratic"])
    reference = certify(Jax().compile(program), Jax.provides, 1 << 10, 0.01)
    assert reference.method != "closed_form"
    # the smoothing of a cost this smooth over sigma = 1e-3 moves the gradient by sigma^2
    assert reference.gradient == pytest.approx(differences(program, program.theta0), rel=AGREES)


def test_breakpoints_are_those_of_the_scenes_own_theta():
    assert compose(Heaviside(), decision=Decision(at=(0.3,))).breakpoints() == ((0.0,),)


# ---------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("scene", "law", "decision", "message"),
    [
        (
            Pushing(),
            Penalty(),
            Decision(("stifness",)),
            r"theta of scene pushing: 'stifness'; did you mean 'stiffness'\?",
        ),
        (Pushing(), Penalty(), Decision(("penalty.mass",)), r"'penalty\.mass'; .*allowed: .*pushing\.mass"),
        (Pushing(), Penalty(), Decision(("horizon",)), r"unknown parameter in theta .* 'horizon'"),
        (Pushing(), Penalty(), Decision(("mass", "pushing.mass")), r"names a parameter twice"),
        (Pushing(), Penalty(), Decision(("mass",), (0.1, 0.2)), r"theta0 has 2 values, theta of scene pushing has 1"),
        (
            BouncingBall(),
            Impulse(),
            Decision(("height",)),
            r"'height', which only sets the own theta of scene bouncing_ball",
        ),
        (Pushing(), Complementarity(), Decision(("stiffness",)), r"give finite values by theta0"),
    ],
    ids=lambda value: str(value.names or value.at) if isinstance(value, Decision) else None,
)
def test_bad_theta_says_what_is_allowed(scene, law, decision, message):
    with pytest.raises(UserError, match=message):
        compose(scene, law, SemiImplicitEuler(), decision)


@dataclasses.dataclass(frozen=True)
class Springy(Pushing):
    """A scene with a stiffness beside that of its contact law."""

    name = "springy"

    stiffness: float = 5.0


def test_name_of_both_scene_and_law_asks_which():
    with pytest.raises(UserError, match=r"write springy\.stiffness or penalty\.stiffness"):
        program_of(Springy(), Penalty(), ("stiffness",))
    for name, value in (
        ("springy.stiffness", 5.0),
        ("scene.stiffness", 5.0),
        ("contact.stiffness", 1e3),
        ("penalty.stiffness", 1e3),
    ):
        assert program_of(Springy(), Penalty(), (name,)).theta0.tolist() == [value]
