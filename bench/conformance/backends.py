"""Checks of backends: their results compared with NumPy's, with differences, and with known solutions."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from bench.conformance.kit import Failed, Skipped, require, skip_unless, verifies
from bench.conformance.subjects import (
    DIFFERENCED,
    N_COLUMNS,
    ROUNDED,
    SAME,
    Z_LIMIT,
    BareScene,
    NewtonOps,
    agree,
    all_programs,
    available,
    describe,
    distinguishing_programs,
    law_for,
    plain_backend,
    representative_programs,
    rng,
    samples,
    stepping,
    with_changed_column,
)
from bench.engines.backend import EngineBackend
from bench.gradient import EPS, FAULTS, TRUSTED, Check, Lines, Options, check, judge, sampled
from bench.gradient.direction import SINGLE_EPS
from bench.host.parameters import parameters
from bench.model import (
    Array,
    Backend,
    EngineScene,
    EngineTwin,
    ForceLaw,
    Integrator,
    Problem,
    Program,
    Replayed,
    Rollout,
    State,
    Unsupported,
    compose,
    param,
)
from bench.model.backend import CAPABILITIES

HUGE = 1e200
"""Size of a theta whose square overflows."""
PRESSED = 1e-3
"""Penetration [m] at which the force of a contact with friction is compared."""
PUSHED = 0.02
"""Relative error allowed in a contact force with friction: an impedance of 1e-4 causes 5e-4 at a friction of 0.5."""
IMPEDANCE = 1e-4
"""The impedance to which a scene's ``twin_difference`` belongs."""
SOLVED = 1e-9
"""Relative error allowed where equations are solved to 1e-12 in the unknown, at a condition number below 100."""


def programs_for(
    backend: Backend, sort: Callable[[list[Program]], list[Program]], candidates: Iterable[Program] | None = None
) -> list[Program]:
    """Return the programs that ``sort`` selects from those the backend can run.

    With non-default parameters, the backend gets only programs without contacts and programs that solve equations.
    """
    runs = [
        program
        for program in (all_programs() if candidates is None else candidates)
        if backend.refusal(program) is None
    ]
    skip_unless(runs, "supports no program")
    if backend == type(backend)():
        return sort(runs)
    few = distinguishing_programs(runs)
    return [program for program in few if program.needs_root or program.contact is None] or few[:1]


def compiled(backend: Backend) -> Iterator[tuple[Program, Problem, np.ndarray, np.ndarray]]:
    """Yield one program of each kind that the backend can run, its problem, and its samples of theta and noise."""
    for program in programs_for(backend, distinguishing_programs):
        yield program, backend.compile(program), *samples(program)


@verifies(Backend)
def value_agrees(backend: Backend) -> str:
    """Verify that costs equal the plain backend's on every scene and law, within the twin's tolerance for engines."""
    skip_unless(not getattr(backend, "own_contact", False), "has contacts of its own")
    plain = plain_backend()
    programs = programs_for(backend, list, [program for program in all_programs() if plain.refusal(program) is None])
    offs = []
    for program in programs:
        theta, w = samples(program)
        value = backend.compile(program).value(theta, w)
        require(value.shape == (N_COLUMNS,), f"{describe(program)}: shape {value.shape}, not {(N_COLUMNS,)}")
        # rollouts may have the same operations in another order
        allowed = _allowed(backend, program, {"float64": SAME, "float32": 1e-3}[_dtype(backend)])
        what = f"{describe(program)}: costs differ by more than {allowed:g}"
        offs.append(agree(value, plain.compile(program).value(theta, w), allowed, what))
    return f"to {max(offs):.0e} on {len(programs)} programs"


def _dtype(backend: Backend) -> str:
    return type(backend)().dtype


def _allowed(backend: Backend, program: Program, exact: float) -> float:
    """Return the allowed relative difference from the scene's own program: ``exact``, or more for physics engines.

    A contact's error is proportional to the declared impedance, the share of other forces that it cancels. An engine in
    another Python may declare a further error of its contact solver.
    """
    scene = program.scene
    if "physics" not in backend.provides or not isinstance(scene, EngineTwin):
        return exact
    if not isinstance(backend, EngineBackend):
        return max(exact, scene.twin_difference)
    ratio = getattr(backend, "impedance", IMPEDANCE) / IMPEDANCE
    error = backend.solver_error if program.contact is not None else 0.0
    return max(exact, scene.twin_difference * ratio + error)


@verifies(Backend)
def gradient_is_that_of_value(backend: Backend) -> str:
    """Verify gradients along random directions by the gradient checker, at kinks and jumps too where it decides there."""
    skip_unless("grad" in backend.provides, "computes no gradients")
    dtype = _dtype(backend)
    worst, judged, programs = 0.0, 0, programs_for(backend, representative_programs)
    for program in programs:
        # also far from theta0, where an adjoint must not use values stored for theta0
        # factor by which the second check of gradients is farther from theta0: 3 sigma instead of 0.1 sigma
        for distant in (1.0, 30.0):
            name = f"{describe(program)}, {distant / 10:g} sigma from theta0"
            found = _findings(backend, program, distant, dtype)
            if program.surrogate and "surrogate" in backend.provides:
                others = (
                    _findings(backend, other, 1.0, dtype)
                    for other in programs_for(backend, list)
                    if isinstance(other.contact, type(program.contact))
                )
                require(
                    any(verdict in FAULTS for one in itertools.chain([found], others) for verdict, _ in one),
                    f"{name}: declares a surrogate gradient, but returns the derivative, also on other scenes",
                )
                break
            for verdict, off in found:
                # relative error of a gradient that always passes, by the type that a backend computes in by
                # default
                is_wrong = verdict in FAULTS and not off < {"float64": 1e-4, "float32": 5e-2}[dtype]
                require(not is_wrong, f"{name}: {verdict}, off by {off:.1e}")
                if verdict in (*FAULTS, *TRUSTED):
                    judged, worst = judged + 1, max(worst, off)
    require(
        judged or dtype == "float64",
        "no gradient can be compared: the scenes' own programs are smooth on no column",
    )
    return f"to {worst:.0e} on {judged} of {2 * len(programs) * N_COLUMNS} columns of {len(programs)} programs"


def _findings(backend: Backend, program: Program, distant: float, dtype: str) -> list[tuple[str, float]]:
    """Return the verdict on each column's derivative along a random direction, and its relative error.

    Float32 needs wide steps, over which a stiff spring can change its slope. There, columns whose plain program is not
    smooth over the same steps are ``unsettled``.
    """
    plain, (theta, w) = plain_backend(), samples(program)
    theta = program.theta0[:, None] + distant * (theta - program.theta0[:, None])
    e, problem, d = rng("direction").standard_normal(theta.shape), backend.compile(program), len(theta)

    with np.errstate(all="ignore"):
        gradient = problem.grad(theta, w)
        require(gradient.shape == theta.shape, f"{describe(program)}: shape {gradient.shape}, not {theta.shape}")
        require(distant > 1.0 or np.isfinite(gradient).all(), f"{describe(program)}: not finite")
        found, *_ = sampled(
            lambda at: problem.value(at[:d], at[d:]),
            Lines(np.concatenate([theta, w]), np.concatenate([e, 0.0 * w]), (gradient * e).sum(axis=0)),
            float(np.finfo(_dtype(backend)).eps),
            EPS if dtype == "float64" else SINGLE_EPS,
        )
        findings = [judge(sample) for sample in found]
        sizes = np.abs(gradient * e).sum(axis=0)
        off = [
            abs(sample.derivative - one.difference) / (abs(one.difference) + size + 1e-9)
            for sample, one, size in zip(found, findings, sizes, strict=True)
        ]
    verdicts = [one.verdict for one in findings]
    if _dtype(backend) == "float32" and plain.refusal(program) is None:
        smooth = [verdict in TRUSTED for verdict, _ in _findings(plain, program, distant, dtype)]
        verdicts = np.where(smooth, verdicts, "unsettled").tolist()
    return list(zip(verdicts, map(float, off), strict=True))


@verifies(Backend)
def score_is_that_of_actions(backend: Backend) -> str:
    """Verify scores: w / sigma without feedback. With feedback, the derivative of log p(actions), with mean 0."""
    skip_unless("score" in backend.provides, "computes no scores")
    details = []
    for program, problem, theta, w in compiled(backend):
        score = problem.score(theta, w)
        if program.noise_on_theta:
            agree(
                score, w[: program.dim] / program.scene.sigma, ROUNDED, f"{describe(program)}: differs from w / sigma"
            )
            continue
        found = _against_log_probability(backend, problem)
        require(found.trusted, f"{describe(program)}: against differences of log p: {found.sentence()}")
        count = 64 if isinstance(backend, EngineBackend) else 4096
        many = problem.score(program.theta0, rng("scores").standard_normal((program.n_noise, count)))
        z = np.abs(many.mean(axis=1)) / (many.std(axis=1) / np.sqrt(count))
        require(z.max() < Z_LIMIT, f"{describe(program)}: the mean is {z.max():.1f} standard errors from zero")
        details.append(f"{describe(program)}: {found.cause}, mean within {z.max():.1f} standard errors of 0")
    return "; ".join(details) or "w / sigma"


def _against_log_probability(backend: Backend, problem: Problem) -> Check:
    """Return the check of a score as the gradient of log p, along an engine's own states: actions follow from these."""
    theta, w = (part[:, :1] for part in samples(problem.program))
    program, has_states = problem.program, type(problem).trajectory is not Problem.trajectory
    is_replayed = "physics" in backend.provides and has_states and isinstance(program, Rollout)
    states = problem.trajectory(theta, w).states if is_replayed else None

    def log_probability(scored: np.ndarray) -> np.ndarray:
        own = program if states is None else Replayed(cast(Rollout, program), states)  # reads its states once
        return np.asarray(own.log_probability(NewtonOps(), theta, scored, w))

    score = problem.score(theta, w)[:, 0]
    return check(log_probability, lambda _: score, theta[:, 0], Options(components=0, draws=0))


@verifies(Backend)
def columns_are_independent(backend: Backend) -> str:
    """Verify that each declared capability gives finite numbers, column by column.

    Column b of a result depends only on column b of theta and w, also alone, and with a shared ``theta (d,)``.
    """
    worst, runs = 0.0, list(compiled(backend))
    for program, problem, theta, w in runs:
        for capability in sorted(backend.provides & {"value", "grad", "score"}):
            function, rest = getattr(problem, capability), np.arange(N_COLUMNS) != 2
            whole, other = function(theta, w), function(*with_changed_column(theta, w))
            is_shaped = whole.shape == ((N_COLUMNS,) if capability == "value" else theta.shape)
            require(is_shaped and whole.dtype == np.float64, f"{capability} is {whole.dtype}{whole.shape}")
            require(np.isfinite(whole).all(), f"{capability} of {describe(program)} is not finite")
            compared = {
                "a column changes others": (other[..., rest], whole[..., rest]),
                "the order of columns matters": (function(theta[:, ::-1], w[:, ::-1])[..., ::-1], whole),
            }
            if program is runs[-1][0]:
                spread = function(np.repeat(program.theta0[:, None], N_COLUMNS, axis=1), w)
                compared["theta (d,) and (d, B) differ"] = function(program.theta0, w), spread
                compared["a single column differs"] = function(program.theta0, w[:, :1]), spread[..., :1]
            for what, both in compared.items():
                worst = max(worst, agree(*both, DIFFERENCED, f"{capability} of {describe(program)}: {what}"))
    return f"to {worst:.0e}"


@verifies(Backend)
def failed_rollouts_have_no_gradient(backend: Backend) -> str:
    """Verify that costs are not finite where the plain backend's are not, and gradients not where costs are not.

    Theta is very large in one column of a batch. An engine that stops, resets or repeats its last state must report
    that.
    """
    skip_unless("grad" in backend.provides, "computes no gradients")
    lost, plain = [], plain_backend()
    for program, problem, theta, w in compiled(backend):
        far = np.where(np.arange(N_COLUMNS) == 1, HUGE * (1.0 + np.abs(theta)), theta)
        with np.errstate(all="ignore"):
            failed = ~np.isfinite(problem.value(far, w))
            gone = ~np.isfinite(problem.grad(far, w)).all(axis=0)
            if plain.refusal(program) is None:
                beyond = ~np.isfinite(plain.compile(program).value(far, w))
                require(failed[beyond].all(), f"{describe(program)}: a rollout that overflows has a finite cost")
        require(gone[failed].all(), f"{describe(program)}: a cost that is not finite has a finite gradient")
        lost.append(failed.any())
    skip_unless(any(lost), f"no rollout fails {HUGE:g} away")
    return f"{sum(lost)} programs"


@verifies(Backend)
def single_precision_is_finite(backend: Backend) -> str:
    """Verify that float32 costs and gradients are close to float64, on continuous scenes without contacts."""
    if (choices := parameters(type(backend))["dtype"].choices) is not None and set(choices) != {"float64", "float32"}:
        raise Skipped(f"computes in {' and '.join(choices)} only")
    single = dataclasses.replace(backend, dtype="float32")
    worst = dict.fromkeys(sorted(backend.provides & {"value", "grad"}), 0.0)
    smooth = [p for p in programs_for(single, distinguishing_programs) if p.contact is None and p.continuous]
    for program, capability in itertools.product(smooth, worst):
        actual, expected = (getattr(b.compile(program), capability)(*samples(program)) for b in (single, backend))
        require(np.isfinite(actual).all(), f"{capability} of {describe(program)}: not finite in float32")
        # relative error allowed in single precision: rollouts round hundreds of times by 6e-8, and central
        # differences keep two or three digits
        off = agree(actual, expected, 1e-2, f"{capability} of {describe(program)}: float32 differs")
        worst[capability] = max(worst[capability], off)
    require(any(worst.values()), "float32 returns the numbers of float64")
    return ", ".join(f"{capability} to {off:.0e}" for capability, off in worst.items())


@verifies(Backend)
def provides_is_truthful(backend: Backend) -> str:
    """Verify that declared capabilities are known, with costs among them, and that equations are rejected without ``root``."""
    strange = sorted(set(backend.provides) - CAPABILITIES)
    require(not strange, f"{', '.join(strange)}: not among {', '.join(sorted(CAPABILITIES))}")
    require("value" in backend.provides, "computes no costs")
    if "root" not in backend.provides:
        try:
            _implicit_problem(backend, 1).value(np.zeros(1), np.zeros((1, 1)))
        except Unsupported:
            return f"{', '.join(sorted(backend.provides))}; rejects equations"
        raise Failed("runs a program that solves an equation, but does not declare root")
    return ", ".join(sorted(backend.provides))


COUPLING = np.array([[2.0, 0.5, -0.3], [0.2, 1.5, 0.4], [-0.6, 0.1, 1.8]])


@dataclass(frozen=True)
class _Initial(BareScene):
    """The cost sum_i (i + 1) q_i after one step from q = theta."""

    name = "conformance_initial"
    n_q = 3

    horizon: int = param(1, "number of time steps", positive=True)
    unknowns: int = param(3, "d, length of theta", positive=True)

    def theta0(self) -> np.ndarray:
        return np.zeros(self.unknowns)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return sum((i + 1.0) * q[i] for i in range(self.unknowns))


@dataclass(frozen=True)
class _Solving(Integrator):
    """A step from q to the solution q+ of COUPLING q+ + q+^3 + 0.1 q+ (q+_0)^2 = q."""

    name = "conformance_solving"
    needs_root = True

    def step(self, dynamics: Any, state: State, u: Array, dt: Any) -> State:
        xp, n = dynamics.ops.xp, state.q.shape[0]

        def residual(z: Array, args: Any) -> Array:
            return _coupled(xp, n, z) - args[0]

        return State(dynamics.ops.root(residual, 0.0 * state.q, (state.q,)), state.v)

    amplification = transition = None  # type: ignore[assignment]


def _coupled(xp: Any, n: int, z: Array) -> Array:
    mixed = xp.stack([sum(COUPLING[i, j] * z[j] for j in range(n)) for i in range(n)])
    return mixed + z * z * z + 0.1 * z * z[0:1] * z[0:1]


def _implicit_problem(backend: Backend, unknowns: int) -> Problem:
    return backend.compile(compose(_Initial(unknowns=unknowns), None, _Solving()))


@dataclass(frozen=True)
class _Pressed(EngineScene, BareScene):
    """A ball of 1 kg that penetrates a plane with friction by 1 mm.

    theta is its velocity along and away from the plane [m/s]. The cost is the velocity away from the plane after one
    step.
    """

    name = "pressed"
    n_q = 2
    n_contacts = 1
    contact_values = {"stiffness": 1e4, "damping": 50.0, "damping_mode": "clipped"}

    horizon: int = param(1, "number of time steps", positive=True)
    dt: float = 1e-4

    def initial_state(self, xp: Any, theta: Array) -> State:
        zero = 0.0 * theta[0]
        return State(xp.stack([zero] * (self.n_q - 1) + [zero + 0.1 - PRESSED]), theta)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return v[-1]

    def mjcf(self) -> str:
        joints = '<joint name="x" type="slide" axis="1 0 0"/>' * (self.n_q - 1)
        contact = 'condim="3" friction="0.5 0.5 1 1 1"' if self.n_q > 1 else 'condim="1"'
        return f"""
            <worldbody>
              <geom name="ground" type="plane" size="1 1 1"/>
              <body>
                {joints}<joint name="z" type="slide" axis="0 0 1"/>
                <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
                <geom name="ball" type="sphere" size="0.1" mass="0"/>
              </body>
            </worldbody>
            <contact><pair geom1="ground" geom2="ball" {contact}/></contact>"""


@dataclass(frozen=True)
class _PressedDown(_Pressed):
    """The same ball without friction, on a vertical slide; theta is its velocity away from the plane [m/s]."""

    name = "pressed_down"
    n_q = 1


def _pressed(backend: Backend, scene: _Pressed, values: dict[str, Any], needs_spring: bool) -> Program:
    """Return the scene under the first law, or spring, that the backend runs. Raises :class:`Skipped` if it runs none."""
    skip_unless("physics" in backend.provides, "does not have its own physics")
    laws = [law_for(scene, law, values) for law in available("contacts")]
    if needs_spring:
        laws = [law for law in laws if isinstance(law, ForceLaw) and law.spring() is not None]
    for program in (compose(scene, law, stepping()) for law in laws):
        if backend.refusal(program) is None:
            return program
    raise Skipped("runs no such contact")


@verifies(Backend)
def frictional_contact_has_the_force_of_its_law(backend: Backend) -> str:
    """Verify the normal force of a contact with friction against the spring law: at rest, closing, parting and creeping.

    The result for a ball that slides at 1 m/s is reported but not limited, since an engine's friction then adds to the
    normal force.
    """
    skip_unless(not getattr(backend, "own_contact", False), "has contacts of its own")
    program = _pressed(backend, _Pressed(), {}, needs_spring=True)
    along, away = np.array([0.0, 0.0, 0.0, 0.01, 1.0]), np.array([0.0, -0.1, 0.1, 0.0, 0.0])
    after = backend.compile(program).value(np.stack([along, away]), np.zeros((program.n_noise, along.size)))
    law = program.contact
    assert isinstance(law, ForceLaw)
    force, expected = (after - away) / _Pressed().dt, law.force(np, np.full((1, along.size), -PRESSED), away[None])[0]
    off = np.abs(force / expected - 1.0)[:-1].max()
    forces = ", ".join(f"{f:.4g} ({e:.4g})" for f, e in zip(force[:-1], expected, strict=False))
    require(off < PUSHED, f"normal forces (and the law's) in N: {forces}")
    return f"to {off:.0e}; sliding at 1 m/s it pushes with {force[-1] / expected[-1]:.2g} times the law's force"


@verifies(Backend)
def pressed_contact_pushes(backend: Backend) -> str:
    """Verify that a ball 1 mm inside a plane is pushed away: engines can ignore a contact without an error."""
    program = _pressed(backend, _PressedDown(), {"damping": 0.0}, needs_spring=False)
    after = backend.compile(program).value(np.array([[-PUSHED]]), np.zeros((program.n_noise, 1)))[0]
    detail = f"by {after + PUSHED:.1e} m/s in {_Pressed().dt:g} s"
    # least change of velocity [m/s] by a contact that presses for 0.1 ms: a spring of 10 kN/m causes 1e-3
    require(after + PUSHED > 1e-5, f"the velocity away changes {detail}")
    return detail


@verifies(Backend)
def root_is_differentiated_implicitly(backend: Backend) -> str:
    """Verify costs and implicit-function gradients for one and for three coupled unknowns, with known solutions."""
    skip_unless("root" in backend.provides, "solves no equations")
    offs = []
    for n in (1, 3) if backend == type(backend)() else (3,):
        z = rng("root").uniform(-1.0, 1.0, (n, N_COLUMNS))
        theta, w = _coupled(np, n, z), np.zeros((n, N_COLUMNS))
        weights = np.arange(1.0, n + 1.0)
        jacobian = COUPLING[:n, :n, None] + np.eye(n)[:, :, None] * (3 * z * z + 0.1 * z[0] * z[0])[:, None]
        jacobian[:, 0] += 0.2 * z * z[0]
        expected = np.linalg.solve(np.moveaxis(jacobian, -1, 0).transpose(0, 2, 1), weights[:, None])[..., 0].T
        problem = _implicit_problem(backend, n)
        offs.append(agree(problem.value(theta, w), weights @ z, SOLVED, f"{n} unknowns: the solution"))
        if "grad" in backend.provides:
            offs.append(agree(problem.grad(theta, w), expected, 10 * SOLVED, f"{n} unknowns: the gradient"))
    return f"to {max(offs):.0e}"
