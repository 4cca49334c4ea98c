"""The gradient health of one rollout: contact, step Jacobians and adjoints, step by step.

Exploding gradients come from somewhere. A :class:`Trace` shows where: it has a row for every state of a rollout, and
says whether the steps over which |dF/dx| or |dL/dx| changes most are those at which a contact is made or lost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import numpy as np
import pandas as pd

from bench import grid, noise, registry
from bench.contracts import (
    Array,
    Dynamics,
    ForceLaw,
    Jacobians,
    MechanicalScene,
    Ops,
    Problem,
    State,
    Unsupported,
)
from bench.errors import UserError
from bench.grid import Cell, Experiment
from bench.program import Program
from bench.session import Session

COLUMNS = (
    "step", "time", "contacts", "switch", "gap", "penetration", "force", "force_peak", "sticking", "slipping",
    "solver_residual", "solver_iterations", "solver_mismatch", "jacobian_norm", "adjoint_norm", "cost_stage",
    "cost_terminal",
)  # fmt: skip
"""Columns of every trace; those of finer costs (``cost_NAME``), states (``q1``, ``v1``) and controls (``u1``) follow."""
MEASURES = {"jacobian_norm": "|dF/dx|", "adjoint_norm": "|dL/dx|"}
"""Columns whose spikes are held against the contact switches, and how they are printed."""
SPIKE = 3.0
"""Factor by which a norm must change over one step for a spike; the first stage cost may double an adjoint innocently."""
TENTH = 0.1
"""Share of the steps, those of the largest changes, that can be spikes."""
LEVEL = 0.05
"""p-value up to which spikes are said to line up with switches."""
NEWTON_TOLERANCE, NEWTON_STEPS = 1e-12, 64


@dataclass(frozen=True)
class Trace:
    """One rollout, step by step."""

    scene: str
    title: str
    """Scene, contact law, integrator, backend and noise."""
    table: pd.DataFrame
    """A row for every state, ``horizon + 1`` in all; NaN where a quantity does not exist, as |dF/dx| at the last state."""
    gradient_error: float
    """|gradient from the adjoints - the program's own gradient|, relative to the latter (absolute where that is 0)."""

    def report(self) -> list[str]:
        """What the trace shows, in sentences."""
        return [_contact_summary(self.table), _gradient_summary(self), *verdict(self.table)]


# ------------------------------------------------------------------------------------------------ from a command


def run(experiment: Experiment, seeded: bool) -> list[Trace]:
    """One trace for each scene of the experiment.

    The noise is w = 0, or with ``seeded`` the first sample of the first repeat that estimators get from that seed.
    Raises :class:`UserError` where there is no rollout or no step Jacobian to trace.
    """
    session = Session(experiment)
    return [_of_cell(session, cell, seeded) for cell in _chosen(experiment)]


def _chosen(experiment: Experiment) -> list[Cell]:
    """One cell a scene, whatever its estimator."""
    found: dict[str, dict[Any, Cell]] = {}
    for cell in grid.cells(experiment):
        found.setdefault(cell.scene.name, {}).setdefault((cell.parts[:4], cell.seed), cell)
    for name, problems in found.items():
        if len(problems) > 1:
            raise UserError(
                f"a trace follows one rollout, and there are {len(problems)} problems of scene {name}: choose one "
                "contact law, integrator, backend and seed, and sweep nothing"
            )
    return [cell for problems in found.values() for cell in problems.values()]


def _of_cell(session: Session, cell: Cell, seeded: bool) -> Trace:
    scene, backend = cell.scene, cell.backend
    if not isinstance(scene, MechanicalScene):
        raise UserError(f"scene {scene.name} is a plain function: it has no steps to trace")
    if scene.needs_physics:
        raise UserError(f"scene {scene.name} runs in physics engines alone, and their contacts are not shown")
    try:
        program = cell.program()
        if program.needs_root and "root" not in backend.provides:
            raise Unsupported(f"a step solves an equation, and backend {backend.name} has no root finder")
        refused = backend.refuses(program)
        if refused:
            raise Unsupported(refused)
        w = np.zeros((program.n_noise, 1))
        if seeded:
            w = noise.draw(cell.seed, scene.name, 1, 1, program.n_noise, "cells")[0].T
        table, error = trace(session.problem(cell), w)
    except Unsupported as error_:
        raise UserError(f"{scene.name} on backend {backend.name} cannot be traced: {error_}{_hint(cell)}") from None
    parts = [registry.identity(part.name, grid.changed(part)) for part in cell.parts[:4] if part is not None]
    drawn = f"noise of seed {cell.seed}" if seeded else "w = 0"
    return Trace(scene.name, ", ".join([*parts, drawn]), table, error)


def _hint(cell: Cell) -> str:
    """The backends that can trace the cell's program, for the end of an error message."""
    able = []
    for name, entry in sorted(registry.entries()["backends"].items()):
        if entry.plugin is None or not entry.available:
            continue
        try:
            program = cell.program()
            backend = cast(Any, entry.plugin)()
            solves = not program.needs_root or "root" in backend.provides
            if solves and not backend.refuses(program) and _linearises(backend.compile(program)):
                able.append(name)
        except Unsupported:
            continue
    return f"; use backends=[{'] or backends=['.join(able)}]" if able else ""


def _linearises(problem: Problem) -> bool:
    return type(problem).jacobians is not Problem.jacobians


# ------------------------------------------------------------------------------------------------------ the trace


def trace(problem: Problem, w: np.ndarray) -> tuple[pd.DataFrame, float]:
    """The table of the rollout at ``theta0`` with noise ``w (n_w, 1)``, and the error of the adjoints' gradient.

    Raises :class:`Unsupported` for backends without step Jacobians.
    """
    program = problem.program
    scene = program.scene
    assert isinstance(scene, MechanicalScene)
    theta = scene.theta0()
    path = Jacobians(*(part[..., 0] for part in problem.jacobians(theta, w)))
    with np.errstate(all="ignore"):
        adjoint, gradient = adjoints(program, theta, w, path)
        seen = {**_contacts(program, path), **_costs(scene, path)}
        seen["jacobian_norm"] = _ended(_norms(path.a))
        seen["adjoint_norm"] = np.linalg.norm(adjoint, axis=1)
    seen["step"] = np.arange(scene.horizon + 1)
    seen["time"] = seen["step"] * scene.dt
    extra = [name for name in seen if name not in COLUMNS]
    states = {f"q{i + 1}": path.states[:, i] for i in range(scene.n_q)}
    states |= {f"v{i + 1}": path.states[:, scene.n_q + i] for i in range(path.states.shape[1] - scene.n_q)}
    controls = {f"u{i + 1}": _ended(path.controls[:, i]) for i in range(scene.n_u)}
    table = pd.DataFrame({name: seen[name] for name in [*COLUMNS, *extra]} | states | controls)
    return table, _gradient_error(gradient, problem.grad(theta, w)[:, 0])


def _gradient_error(gradient: np.ndarray, own: np.ndarray) -> float:
    scale = float(np.linalg.norm(own))
    return float(np.linalg.norm(gradient - own)) / (scale or 1.0)


def _norms(matrices: np.ndarray) -> np.ndarray:
    """Spectral norms of ``(T, n, n)``; inf where an entry is not finite, which LAPACK would refuse."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    norms = np.full(len(matrices), np.inf)
    norms[finite] = np.linalg.norm(matrices[finite], 2, axis=(1, 2))
    return norms


def _ended(values: np.ndarray) -> np.ndarray:
    """Values of the steps, with NaN for the last state, from which there is no step."""
    return np.append(np.asarray(values, dtype=np.float64), np.nan)


def _split(scene: MechanicalScene, x: Array) -> State:
    return State(x[: scene.n_q], x[scene.n_q :])


def adjoints(program: Program, theta: np.ndarray, w: np.ndarray, path: Jacobians) -> tuple[np.ndarray, np.ndarray]:
    """dL/dx_k along a rollout, ``(T + 1, n)``, and the gradient dL/dtheta that follows from it, ``(d,)``.

    With stage costs c_k(x_k, u_k), control u_k = pi(theta, x_k), and the steps' A_k, B_k (``path`` without batch axis),
    p_k = dc_k/du + B_k' l_{k+1} and l_k = A_k' l_{k+1} + dc_k/dx + (dpi/dx)' p_k, from l_T = dc_T/dx; then
    dL/dtheta = (dx_0/dtheta)' l_0 + sum_k (dpi/dtheta)' p_k. Costs and policy are differentiated by JAX, with the steps
    as batch columns, whatever backend gave the steps. Source: Griewank and Walther 2008, ch. 3.
    """
    import jax
    import jax.numpy as jnp

    scene = program.scene
    assert isinstance(scene, MechanicalScene)
    ops = cast(Ops, SimpleNamespace(xp=jnp))
    before, end = jnp.asarray(path.states[:-1].T), jnp.asarray(path.states[-1:].T)
    count, size = before.shape[1], before.shape[0]

    def first(theta: Array) -> Array:
        return jnp.concatenate(program.start(ops, theta, w)[1])

    def controls(theta: Array, x: Array) -> Array:
        theta, _, scanned = program.start(ops, theta, w)
        slices = tuple(part[:, :, 0].T for part in scanned)
        return program.control(ops, jnp.broadcast_to(theta, (theta.shape[0], count)), _split(scene, x), slices)

    def stage(x: Array, u: Array) -> Array:
        return jnp.sum(jnp.asarray(scene.stage_cost(jnp, *_split(scene, x), u)))

    def terminal(x: Array) -> Array:
        return jnp.sum(scene.terminal_cost(jnp, *_split(scene, x)))

    def along(e: Array) -> Array:
        return jax.jvp(lambda x: controls(column, x), (before,), (jnp.broadcast_to(e[:, None], before.shape),))[1]

    column = jnp.asarray(theta)[:, None]
    by_state, by_control = (np.asarray(part) for part in jax.grad(stage, (0, 1))(before, jnp.asarray(path.controls.T)))
    feedback = np.asarray(jax.vmap(along)(jnp.eye(size)))
    adjoint = np.empty((count + 1, size))
    adjoint[count] = np.asarray(jax.grad(terminal)(end))[:, 0]
    pulls = np.empty_like(path.controls)
    for k in reversed(range(count)):
        pulls[k] = by_control[:, k] + path.b[k].T @ adjoint[k + 1]
        adjoint[k] = path.a[k].T @ adjoint[k + 1] + by_state[:, k] + feedback[:, :, k] @ pulls[k]
    back = jax.vjp(lambda t: (first(t), controls(t, before)), column)[1]
    return adjoint, np.asarray(back((jnp.asarray(adjoint[0])[:, None], jnp.asarray(pulls.T)))[0])[:, 0]


def _costs(scene: MechanicalScene, path: Jacobians) -> dict[str, np.ndarray]:
    """Cost terms by name, ``(T + 1,)``: stage costs at the states before the steps, the terminal cost at the last.

    A scene may offer a method ``cost_terms(xp, q, v, u)`` with the parts of its stage cost by name.
    """
    states, u = path.states.T, path.controls.T
    before = _split(scene, states[:, :-1])

    def staged(value: Any) -> np.ndarray:
        return _ended(np.broadcast_to(value, u.shape[1]))

    terms = {"stage": staged(scene.stage_cost(np, *before, u))}
    terms["terminal"] = np.full(states.shape[1], np.nan)
    terms["terminal"][-1] = scene.terminal_cost(np, *_split(scene, states[:, -1:]))[0]
    finer: Callable[..., Any] | None = getattr(scene, "cost_terms", None)
    if finer is not None:
        terms |= {name: staged(value) for name, value in finer(np, *before, u).items()}
    return {f"cost_{name}": values for name, values in terms.items()}


# ------------------------------------------------------------------------------------------------------- contacts


def _contacts(program: Program, path: Jacobians) -> dict[str, np.ndarray]:
    """The columns on contact and on the equations of the steps, ``(T + 1,)`` each."""
    scene, law = program.scene, program.contact
    assert isinstance(scene, MechanicalScene)
    count = len(path.states)
    nothing = np.full(count, np.nan)
    seen = dict.fromkeys(("gap", "penetration", "force", "force_peak", "sticking", "slipping"), nothing)
    seen |= dict.fromkeys(("solver_residual", "solver_iterations", "solver_mismatch"), nothing)
    seen |= {"contacts": np.zeros(count, dtype=int), "switch": np.zeros(count, dtype=int)}
    state = _split(scene, path.states.T)
    after = None
    if program.needs_root:
        after, solved = _resolved(program, path)
        seen |= solved
    if law is None:
        return seen
    gap = scene.gap(np, state.q)
    touching, force = _touching(program, path, gap, after)
    mode = touching.astype(int)
    slip = scene.slip(np, *state)
    if slip is not None and scene.friction > 0:
        mode = np.where(touching & (np.abs(slip) > scene.slip_speed), 2, mode)
        seen |= {"sticking": (mode == 1).sum(axis=0), "slipping": (mode == 2).sum(axis=0)}
    total = force.sum(axis=0)
    return seen | {
        "contacts": touching.sum(axis=0),
        "switch": np.append(0, (mode[:, 1:] != mode[:, :-1]).any(axis=0).astype(int)),
        "gap": gap.min(axis=0),
        "penetration": np.maximum(0.0, -gap).max(axis=0),
        "force": total,
        "force_peak": np.fmax.accumulate(total),
    }


def _touching(
    program: Program, path: Jacobians, gap: np.ndarray, after: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Which contacts touch at each state, and their normal forces [N], both ``(n_contacts, T + 1)``.

    Under a force law a contact touches while its gap is negative, and the force is the law's at the state. Under an
    impulse law the force is the impulse of the step over dt, and the contact touches besides where that impulse opens
    the gap by more than is left of it after the step: dt^2 (J M^-1 J^T)_ii lambda_i > gap_i. On the central path, where
    forces act at every distance, this is where a contact-free step would overlap. The last state keeps the contacts
    of the step that led to it.
    """
    scene, law = program.scene, program.contact
    assert isinstance(scene, MechanicalScene)
    state = _split(scene, path.states.T)
    if isinstance(law, ForceLaw):
        return gap < 0, law.force(np, gap, scene.gap_rate(np, *state)) + 0.0
    force = _impulse_forces(program, path, after)
    contact = Dynamics(cast(Ops, SimpleNamespace(xp=np)), scene, law).contact
    assert contact is not None
    opened = scene.dt**2 * contact.response(np, state.q[:, :-1]) * force
    pushed = (force > 0) & (opened > gap[:, 1:])
    touching = (gap[:, :-1] < 0) | pushed
    nothing = np.full((len(gap), 1), np.nan)
    return np.append(touching, touching[:, -1:], axis=1), np.append(force, nothing, axis=1)


def _impulse_forces(program: Program, path: Jacobians, after: np.ndarray | None) -> np.ndarray:
    """Normal forces ``(n_contacts, T)`` [N] whose impulses make the difference to a step without the contact law.

    Least squares of M^-1 J^T lambda dt = v_{k+1} - v_free, exact for contacts whose normals are independent.
    """
    scene = program.scene
    assert isinstance(scene, MechanicalScene)
    q = _split(scene, path.states[:-1].T).q
    if after is None:
        after = _stepped(program, path, _Newton())
    free = _stepped(Program(scene, None, program.integrator), path, _Newton())
    jump = _split(scene, after - free).v
    units = np.eye(scene.n_contacts)[:, :, None] + np.zeros((1, 1, q.shape[1]))
    response = np.stack([scene.contact_acceleration(np, q, unit) for unit in units])
    inverse = np.linalg.pinv(np.nan_to_num(response.transpose(2, 1, 0)))
    return (inverse @ jump.T[:, :, None])[:, :, 0].T / scene.dt


def _stepped(program: Program, path: Jacobians, ops: _Newton) -> np.ndarray:
    """The states after each step, ``(n, T)``, taken outside the rollout with the steps as batch columns."""
    import jax.numpy as jnp

    scene = program.scene
    assert isinstance(scene, MechanicalScene)
    before, u = jnp.asarray(path.states[:-1].T), jnp.asarray(path.controls.T)
    return np.concatenate([np.asarray(part) for part in program.step(cast(Ops, ops), _split(scene, before), u)])


# ---------------------------------------------------------------------------------------------- equations of a step


class _Newton:
    """Array operations whose ``root`` is a plain Newton's method that keeps each column's residual and iterations."""

    def __init__(self) -> None:
        import jax.numpy

        self.xp = jax.numpy
        self.residuals: list[np.ndarray] = []
        self.iterations: list[np.ndarray] = []

    def root(self, residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
        """The root by columns, each left as it is once its own Newton step is within tolerance."""
        import jax
        import jax.numpy as jnp

        def derivative(z: Array) -> Array:
            basis = jnp.eye(len(z))[:, :, None] + jnp.zeros_like(z)
            return jax.vmap(lambda e: jax.jvp(lambda y: residual(y, args), (z,), (e,))[1], out_axes=1)(basis)

        z, count, going = guess, np.zeros(guess.shape[1]), np.ones(guess.shape[1], dtype=bool)
        for _ in range(NEWTON_STEPS):
            move = jnp.linalg.solve(jnp.moveaxis(derivative(z), -1, 0), residual(z, args).T[:, :, None])[:, :, 0].T
            z = jnp.where(going, z - move, z)
            count += going
            going &= ~np.asarray(jnp.all(jnp.abs(move) <= NEWTON_TOLERANCE * (1.0 + jnp.abs(z)), axis=0))
            if not going.any():
                break
        self.residuals.append(np.max(np.abs(np.asarray(residual(z, args))), axis=0))
        self.iterations.append(count)
        return z


def _resolved(program: Program, path: Jacobians) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The states after each step solved once more, ``(n, T)``, and the columns that says something of.

    A backend's own solver runs inside the compiled rollout and reports nothing. So each step is solved again from its
    state by Newton's method with the law's own first guess: ``solver_residual`` is the largest component left (in the
    unit of the law's equation), ``solver_iterations`` the Newton steps, the last one, within tolerance, included;
    ``solver_mismatch`` is the largest difference to the state that the backend's solver led to.
    """
    ops = _Newton()
    after = _stepped(program, path, ops)
    return after, {
        "solver_residual": _ended(np.max(ops.residuals, axis=0)),
        "solver_iterations": _ended(np.sum(ops.iterations, axis=0)),
        "solver_mismatch": _ended(np.max(np.abs(after - path.states[1:].T), axis=0)),
    }


# --------------------------------------------------------------------------------------------- spikes and switches


class Alignment(NamedTuple):
    """How many spikes are within one step of a contact switch, held against chance."""

    spikes: int
    near: int
    chance: float
    """Share of the steps that are within one step of a switch."""
    p_value: float
    """Chance that as many spikes or more, put at random on different steps, are near a switch: the exact permutation test."""


def changes(values: Sequence[float] | np.ndarray) -> np.ndarray:
    """|log ratio| of neighbouring values, ``(T,)`` for ``(T + 1,)``; 0 where one is zero or not finite."""
    with np.errstate(all="ignore"):
        steps = np.abs(np.diff(np.log(np.asarray(values, dtype=np.float64))))
    return np.where(np.isfinite(steps), steps, 0.0)


def spikes(values: Sequence[float] | np.ndarray) -> np.ndarray:
    """The steps that are spikes, boolean ``(T,)``: changes above :data:`SPIKE` and among the largest tenth.

    Of neighbouring such steps only the largest counts: a rise over several steps is one spike.
    """
    steps = changes(values)
    largest = np.sort(steps)[-max(1, int(TENTH * len(steps)))]
    high = (steps > np.log(SPIKE)) & (steps >= largest)
    found = np.zeros(len(steps), dtype=bool)
    for run in np.split(np.arange(len(steps)), np.flatnonzero(np.diff(high.astype(int))) + 1):
        if high[run[0]]:
            found[run[np.argmax(steps[run])]] = True
    return found


def align(values: Sequence[float] | np.ndarray, switch: Sequence[int] | np.ndarray) -> Alignment:
    """Spikes of ``values (T + 1,)`` against ``switch (T + 1,)``, 1 where contacts differ from the state before."""
    from scipy.stats import hypergeom

    spiked = spikes(values)
    switched = np.asarray(switch[1:], dtype=bool)
    near = switched.copy()
    near[1:] |= switched[:-1]
    near[:-1] |= switched[1:]
    hits, steps, covered, drawn = (int(n) for n in ((spiked & near).sum(), len(near), near.sum(), spiked.sum()))
    p_value = float(hypergeom.sf(hits - 1, steps, covered, drawn))
    return Alignment(drawn, hits, covered / steps, p_value)


def verdict(table: pd.DataFrame) -> list[str]:
    """Whether gradient spikes line up with contact switches: a sentence, or one for each measure."""
    largest = {name: float(np.exp(changes(table[name]).max())) for name in MEASURES}
    change = " and ".join(f"{MEASURES[name]} by at most {number(factor)}x" for name, factor in largest.items())
    if not table["contacts"].any():
        afar = f" (forces of up to {number(table['force'].max())} N act from afar)" if table["force"].max() > 0 else ""
        return [f"No contact in this rollout{afar}, so no switch for a spike to line up with; per step, {change}."]
    switches = int(table["switch"].sum())
    if not switches:
        return [f"Contact never switches in this rollout, so no spike can line up with it; per step, {change}."]
    return [
        _sentence(MEASURES[name], align(table[name], table["switch"]), switches, largest[name]) for name in MEASURES
    ]


def _sentence(name: str, found: Alignment, switches: int, largest: float) -> str:
    counted = _counted(switches, "contact switch", "contact switches")
    if not found.spikes:
        return f"{name} has no spike at the {counted}: it changes by at most {number(largest)}x over a step."
    share, chance = _percent(found.near / found.spikes), _percent(found.chance)
    counted_spikes = _counted(found.spikes, "spike", "spikes")
    return (
        f"{name}: {counted_spikes} (largest tenth of the changes, above {SPIKE:g}x a step), {found.near} within one "
        f"step of the {counted}: {share} against {chance} by chance, p = {found.p_value:.2g}. "
        f"{_said(found)}"
    )


def _said(found: Alignment) -> str:
    if found.near == 0:
        return "No spike lines up with a contact switch."
    if found.p_value <= LEVEL:
        return "Spikes line up with contact switches."
    return "Whether spikes line up with contact switches cannot be told from chance."


def _counted(count: int, one: str, several: str) -> str:
    return f"{count} {one if count == 1 else several}"


def number(value: float) -> str:
    """Three digits, with an exponent only where there is no other short way: ``0.0126``, ``1,900``, ``2.5e+07``."""
    return f"{value:,.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f}%"


def _contact_summary(table: pd.DataFrame) -> str:
    if table["gap"].isna().all():
        return f"{len(table) - 1} steps, no contacts in this scene."
    touching = int((table["contacts"] > 0).sum())
    return (
        f"{len(table) - 1} steps; {touching} of {len(table)} states in contact, "
        f"{_counted(int(table['switch'].sum()), 'switch', 'switches')}; penetration up to "
        f"{number(table['penetration'].max())} m, force up to {number(table['force'].max())} N."
    )


def _gradient_summary(found: Trace) -> str:
    norms = found.table[list(MEASURES)].replace([np.inf, -np.inf], np.nan)
    ranges = [f"{MEASURES[name]} {number(norms[name].min())} to {number(norms[name].max())}" for name in MEASURES]
    return f"{', '.join(ranges)}; the adjoints' gradient is within {found.gradient_error:.1g} of the program's."
