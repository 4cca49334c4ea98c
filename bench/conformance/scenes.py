"""Checks of scenes: costs, continuity, declared gradients, contact geometry."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from bench.conformance.kit import Failed, Skipped, require, skip_unless, verifies
from bench.conformance.subjects import (
    DIFFERENCED,
    N_COLUMNS,
    ROUNDED,
    SAME,
    Z_LIMIT,
    able_backend,
    agree,
    available,
    backends,
    can_run,
    describe,
    distance,
    largest_jump,
    law_for,
    plain_backend,
    programs,
    rng,
    samples,
    sound_laws,
    standard_errors,
    stepping,
    with_changed_column,
    works,
)
from bench.model import (
    ContactLaw,
    ContactScene,
    EngineScene,
    ImpulseLaw,
    Integrator,
    MechanicalScene,
    Program,
    Scene,
    ZeroOrderHoldScene,
    compose,
)

SCORED_STEPS = 8
"""Most steps of the rollouts in which scores are checked."""
FINER = (4, 16)
"""Factors by which the time step is divided to approach the physics."""
SPAN, POINTS = 0.2, 65
"""Half range in sigma, and number of costs, of the fit that separates the physics' slope from jumps between steps."""
LIMITING = 0.05
"""Largest relative difference of a coordinate between two converged refinements, and of a refinement from the physics."""
ELSEWHERE = 6.0
"""Offset from theta0, in sigma, of further lines that are searched for jumps."""


@verifies(Scene)
def theta_and_noise_are_declared(scene: Scene) -> str:
    """Verify that theta0 is a finite vector, the noise is one of the two models, and breakpoints are finite."""
    theta = scene.theta0()
    require(isinstance(theta, np.ndarray) and theta.ndim == 1 and theta.size, "theta0 must be a vector (d,)")
    require(theta.dtype == np.float64 and np.isfinite(theta).all(), "theta0 must be finite and of type float64")
    require(np.array_equal(theta, scene.theta0()), "theta0 differs between calls")
    allowed = ("parameter", "action") if isinstance(scene, MechanicalScene) and scene.n_u else ("parameter",)
    require(scene.noise in allowed, f"noise '{scene.noise}' is none of {', '.join(allowed)}")
    breaks = scene.breakpoints()
    require(len(breaks) <= theta.size, f"{len(breaks)} lists of breakpoints for {theta.size} coordinates")
    for edges in breaks:
        require(np.isfinite(edges).all(), f"breakpoints {edges} are not finite")
    return f"d = {theta.size}, {scene.noise} noise"


@verifies(Scene)
def costs_are_finite(scene: Scene) -> str:
    """Verify that costs are ``(B,)`` and finite, and each depends only on its own column, under every contact law."""
    subjects = programs(scene)
    for program in subjects:
        (theta, w), problem = samples(program), able_backend(program).compile(program)
        cost = problem.value(theta, w)
        require(cost.shape == (N_COLUMNS,), f"{describe(program)}: shape {cost.shape}, not {(N_COLUMNS,)}")
        require(np.isfinite(cost).all(), f"{describe(program)}: {(~np.isfinite(cost)).sum()} costs are not finite")
        other = problem.value(*with_changed_column(theta, w))
        kept = np.arange(N_COLUMNS) != 2
        agree(other[kept], cost[kept], ROUNDED, f"{describe(program)}: a column changes the cost of others")
    return f"{cost.mean():.4g} on average, {len(subjects)} programs"


@verifies(Scene)
def gradient_is_finite(scene: Scene) -> str:
    """Verify that a library's derivative of the cost is finite at theta0, over at most :data:`SCORED_STEPS` steps."""
    for program in programs(_brief(scene)):
        able = [b for b in backends() if b.compiles and "grad" in b.provides and "physics" not in b.provides]
        backend = next((b for b in able if can_run(b, program) and works(b)), None)
        if backend is not None:
            gradient = backend.compile(program).grad()
            wrong = np.flatnonzero(~np.isfinite(gradient))
            require(
                not wrong.size,
                f"{describe(program)}: by {backend.name} the gradient at theta0 is not a number in component "
                f"{', '.join(map(str, wrong[:4]))}: a sqrt, norm or division at the edge of its domain",
            )
            return f"{describe(program)}, {backend.name}: norm {np.linalg.norm(gradient):.4g}"
    raise Skipped("no available backend differentiates it by a library")


def _brief(scene: Scene) -> Scene:
    """Return the scene with at most :data:`SCORED_STEPS` steps."""
    if not isinstance(scene, MechanicalScene):
        return scene
    return dataclasses.replace(scene, horizon=min(scene.horizon, SCORED_STEPS))


@verifies(Scene)
def noise_is_where_declared(scene: Scene) -> str:
    """Verify that costs at (theta, w) equal costs at (theta + sigma w, 0), except for action noise under a policy."""
    program = programs(scene)[0]
    skip_unless(program.noise_on_theta, "its noise is on the actions of a policy")
    wanted = program.dim + program.exogenous
    require(program.n_noise == wanted, f"{program.n_noise} normal numbers for {program.dim} components of theta")
    (theta, w), problem = samples(program), able_backend(program).compile(program)
    shift = scene.sigma * w[: program.dim]
    off = agree(
        problem.value(theta + shift, problem.centred(w)),
        problem.value(theta, w),
        SAME,
        "noise w and a step of sigma w in theta differ: theta and the controls differ",
    )
    return f"on theta, to {off:.0e}"


@verifies(Scene)
def backends_agree(scene: Scene) -> str:
    """Verify that every available backend computes the same cost under every contact law that it can run.

    Backends with their own physics have a separate check, with the tolerance that the scene declares for its twin.
    """
    skip_unless(not isinstance(scene, EngineScene), "runs in physics engines only")
    worst, names = 0.0, set()
    for program in programs(scene):
        theta, w = samples(program)
        expected = able_backend(program).compile(program).value(theta, w)
        for backend in backends():
            if "physics" not in backend.provides and can_run(backend, program):
                try:
                    off = distance(backend.compile(program).value(theta, w), expected)
                except Exception:
                    if works(backend):
                        raise
                    continue
                require(off < SAME, f"{describe(program)}: {backend.name} differs by {off:.1e}")
                worst = max(worst, off)
                names.add(backend.name)
    return f"{', '.join(sorted(names))} to {worst:.0e}"


@verifies(Scene)
def continuity_is_as_declared(scene: Scene) -> str:
    """Verify that the cost does not jump along lines near theta0 if ``continuous``, and jumps on at least one if not.

    The lines run through theta0, and for a continuous scene also 6 sigma away from it. The contact law is continuous.
    """
    subjects = [p for p in programs(scene) if p.contact is None or p.contact.continuous]
    runs = [p for p in subjects if plain_backend().refusal(p) is None] or subjects
    skip_unless(runs, "no continuous contact law is available")
    jump = largest_jump(runs[0], lines=2)
    if scene.continuous:
        where = f"within {ELSEWHERE + 4:g} sigma of theta0"
        jump = jump or max(largest_jump(runs[0], offset=side * ELSEWHERE) for side in (1, -1))
        detail = f"jumps by {jump:.1e} of its range {where} under {describe(runs[0])}"
        require(not jump, f"is continuous unless it declares `continuous = False`, but {detail}")
        return f"no jump {where}"
    require(jump, "declares to jump, but no jump was found within 4 sigma of theta0")
    return f"a jump of {jump:.2g} of the range"


@verifies(Scene)
def closed_form_is_right(scene: Scene) -> str:
    """Verify the closed form against long sampling for every law and integrator, at the default sigma and its double."""
    worst, count = 0.0, 0
    for sigma in (scene.sigma, 2 * scene.sigma):
        for program in _all_combinations(dataclasses.replace(scene, sigma=sigma)):
            closed = program.closed_form_gradient()
            if closed is None:
                continue
            shape = np.shape(closed)
            require(shape == (program.dim,), f"{describe(program)}: shape {shape}, not {(program.dim,)}")
            mean, error = _sampled_gradient(program)
            z = float(standard_errors(mean - closed, error, DIFFERENCED * (1 + np.abs(closed))).max())
            detail = f"{describe(program)}, sigma = {sigma:g}: {z:.1f} standard errors from the sampled gradient"
            require(z < Z_LIMIT, detail)
            worst, count = max(worst, z), count + 1
    skip_unless(count, "has none")
    return f"{count} programs, at most {worst:.1f} standard errors from sampling"


def _all_combinations(scene: Scene) -> Iterator[Program]:
    if not isinstance(scene, MechanicalScene):
        yield compose(scene)
        return
    laws = [law_for(scene, law) for law in sound_laws()] if scene.n_contacts else [None]
    for law, integrator in itertools.product(laws, available("integrators")):
        if not isinstance(law, ImpulseLaw) or integrator.takes_impulses:
            yield compose(scene, law, integrator())


def _sampled_gradient(program: Program) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard error ``(d,)`` of first-order terms, or of zeroth-order terms if the program jumps."""
    problem, theta = able_backend(program).compile(program), program.theta0
    w = rng("closed form").standard_normal((program.n_noise, 1 << 12))
    if program.continuous:
        terms = problem.grad(theta, w)
    else:
        terms = (problem.value(theta, w) - problem.value(theta, -w)) / 2 * problem.score(theta, w)
    return terms.mean(axis=1), terms.std(axis=1) / math.sqrt(w.shape[1])


@verifies(Scene)
def score_gives_the_gradient(scene: Scene) -> str:
    """Verify that the mean of cost times score equals the mean gradient of the cost.

    Rollouts have at most :data:`SCORED_STEPS` steps, since the variance of both means grows with the number of steps.
    """
    runs = [p for p in programs(_brief(scene)) if p.continuous and plain_backend().refusal(p) is None]
    skip_unless(runs, "no continuous program runs on the plain backend")
    program = runs[0]
    skip_unless(not program.score_refusal, program.score_refusal)
    problem, theta = plain_backend().compile(program), program.theta0[:, None]
    w = rng("score", scene.name).standard_normal((program.n_noise, 1 << 13))
    centre = problem.value(theta, np.zeros((program.n_noise, 1)))
    # the average over w and -w has the same expectation and less variance
    terms = sum(
        ((problem.value(theta, s) - centre) * problem.score(theta, s) - problem.grad(theta, s)) / 2 for s in (w, -w)
    )
    mean, error = terms.mean(axis=1), terms.std(axis=1) / math.sqrt(w.shape[1])
    size = DIFFERENCED * (1 + np.abs(problem.grad(theta, w[:, :1])).max())
    z = float(standard_errors(mean, error, size).max())
    require(
        z < Z_LIMIT, f"{describe(program)}: E[cost score] is {z:.1f} standard errors from the mean gradient of the cost"
    )
    return f"{z:.1f} standard errors from differences"


@verifies(Scene)
def physical_gradient_is_the_limit(scene: Scene) -> str:
    """Verify that the cost's slope converges to the physical gradient as time steps get finer, under at least one law.

    Another law may converge to another slope, such as a spring that approximates a rigid impact. The check is skipped
    if the slopes converge under no law.
    """
    gradient = scene.physical_gradient()
    if gradient is None:
        raise Skipped("has none")
    require(gradient.shape == scene.theta0().shape, f"shape {gradient.shape}, not {scene.theta0().shape}")
    require(np.isfinite(gradient).all(), f"{gradient} is not finite")
    apart: dict[str, float] = {}
    for law, integrator in _towards_physics(scene):
        ratios = []
        for factor in FINER:
            program = _refined(scene, factor, law, integrator)
            physical = program.scene.physical_gradient()
            if physical is None:
                raise Failed(f"has a physical gradient at its own step, but none at a step finer by {factor}")
            ratios.append(_ratios(program, physical))
        off = float(np.abs(ratios[1] - 1.0).max())
        if off <= LIMITING:
            return f"{describe(program)} is {off:.1g} from it at a step finer by {FINER[1]}"
        # the slope of a coordinate that acts for one step changes with dt, but its ratio to the physical slope converges
        if np.isfinite(ratios).all() and np.abs(ratios[1] - ratios[0]).max() <= LIMITING:
            apart[describe(program)] = off
    skip_unless(apart, "the differences of no program converge at finer steps")
    nearest = min(apart, key=lambda name: apart[name])
    raise Failed(
        f"{', '.join(apart)} converge to other slopes as steps get finer; the nearest, {nearest}, differs by {apart[nearest]:.0%}"
    )


def _towards_physics(scene: Scene) -> Iterator[tuple[ContactLaw | None, Integrator | None]]:
    """Yield the laws and integrators under which a scene's program may converge to its physics, most likely first."""
    if not isinstance(scene, MechanicalScene):
        yield None, None
    elif scene.n_contacts:
        laws = sorted(sound_laws(), key=lambda law: not issubclass(law, ImpulseLaw))
        yield from ((law_for(scene, law), stepping()) for law in laws if not law.needs_root)
    else:
        explicit = [plugin() for plugin in available("integrators") if not plugin.needs_root]
        yield None, max(explicit, key=lambda integrator: integrator.order)


def _refined(scene: Scene, factor: int, law: ContactLaw | None, integrator: Integrator | None) -> Program:
    """Return the scene's program with dt divided by ``factor``, over the same time.

    Raises :class:`Skipped` if theta changes its length.
    """
    if not isinstance(scene, MechanicalScene):
        return compose(scene)
    finer: dict[str, Any] = {"horizon": scene.horizon * factor, "dt": scene.dt / factor}
    if isinstance(scene, ZeroOrderHoldScene):
        finer["hold"] = scene.hold * factor
    fine = dataclasses.replace(scene, **finer)
    skip_unless(fine.theta0().shape == scene.theta0().shape, "theta is longer at a finer step")
    return compose(fine, law, integrator)


def _ratios(program: Program, physical: np.ndarray) -> np.ndarray:
    """Return the slopes of the cost at theta0 over the physical gradient, ``(d,)``; 1 where both are 0 to rounding.

    A slope comes from a cubic fitted to costs on both sides, so that a program's jumps between time steps average out.
    """
    problem, theta, d = able_backend(program).compile(program), program.theta0, program.dim
    span = SPAN * program.scene.sigma
    along = np.linspace(-1.0, 1.0, POINTS)
    shifts = (np.eye(d)[:, :, None] * (span * along)).reshape(d, -1)
    cost = problem.value(theta[:, None] + shifts, np.zeros((program.n_noise, d * POINTS))).reshape(d, POINTS)
    slope = np.polynomial.polynomial.polyfit(along, cost.T, 3)[1] / span
    none = np.maximum(np.abs(slope), np.abs(physical)) <= 1e-12 * np.abs(cost).max(axis=1) / span
    return np.divide(slope, physical, out=np.where(none, 1.0, np.inf), where=~none & (physical != 0.0))


@verifies(MechanicalScene)
def state_has_declared_size(scene: MechanicalScene) -> str:
    """Verify that the initial state is ``q (n_q, B)`` and ``v (n_v, B)``."""
    require(hasattr(scene, "n_q"), "does not declare the length of q: set the class variable n_q")
    state = scene.initial_state(np, scene.theta0()[:, None])
    n_v = scene.n_v
    require(state.q.shape == (scene.n_q, 1), f"n_q = {scene.n_q}, but q has shape {state.q.shape} for one column")
    require(state.v.shape == (n_v, 1), f"v should have length {n_v}, but has shape {state.v.shape} for one column")
    return f"n_q = {scene.n_q}, n_v = {n_v}"


@verifies(EngineScene)
def start_and_costs_are_traceable(scene: EngineScene) -> str:
    """Verify that JAX can trace the initial state, the feedback and the final cost, parameters included."""
    try:
        import jax
        import jax.numpy as jnp
    except ImportError:
        raise Skipped("needs jax") from None
    program = programs(scene)[0]

    def trace(parameters: Any, theta: Any) -> Any:
        bound = program.bind(parameters).scene
        assert isinstance(bound, EngineScene)
        state = bound.initial_state(jnp, theta)
        return state, bound.feedback(jnp, theta, state.q, state.v), bound.terminal_cost(jnp, state.q, state.v)

    try:
        jax.eval_shape(trace, program.parameters(), program.theta0[:, None])
    except jax.errors.JAXTypeError as error:
        cause = str(error).splitlines()[0]
        raise Failed(f"JAX cannot trace it: {cause}: compute with the given xp instead of numpy or float()") from error
    return f"{program.parameters().size} parameters traced"


@verifies(ContactScene)
def contact_geometry_is_consistent(scene: ContactScene) -> str:
    """Verify that ``gap_rate`` is the time derivative of ``gap``, and that forces act linearly and push bodies apart."""
    require(scene.n_contacts > 0, "n_contacts is 0: a ContactScene sets it to the number of its gaps")
    draw = rng("geometry")
    start = scene.initial_state(np, scene.theta0()[:, None])
    q = start.q + 0.1 * draw.standard_normal((scene.n_q, N_COLUMNS))
    v = start.v + draw.standard_normal((start.v.shape[0], N_COLUMNS))
    shape = (scene.n_contacts, N_COLUMNS)
    require(scene.gap(np, q).shape == shape, f"gap has shape {scene.gap(np, q).shape}, not {shape}")
    off = distance(scene.gap_rate(np, q, v), (scene.gap(np, q + 1e-6 * v) - scene.gap(np, q - 1e-6 * v)) / 2e-6)
    # 1e-6: central differences of step 1e-6 of a smooth gap have errors of 1e-10 by rounding and 1e-12 by truncation
    require(off < 1e-6, f"gap_rate differs from the derivative of gap by {off:.1e}")
    a, b = draw.uniform(0.0, 1.0, (2, *shape))
    pushed, parts = scene.contact_acceleration(np, q, a + 2 * b), [scene.contact_acceleration(np, q, f) for f in (a, b)]
    require(pushed.shape == v.shape, f"contact_acceleration has shape {pushed.shape}, not {v.shape}")
    require(distance(pushed, parts[0] + 2 * parts[1]) < ROUNDED, "contact_acceleration is not linear in the force")
    response = scene.contact(np).response(np, q)
    require((response > 0).all(), f"a force of 1 N changes its own gap by {response.min():.3g} m/s^2: it pulls")
    return f"response {response.min():.3g} to {response.max():.3g} per kg"
