"""Where a gradient is right, wrong or lost, over step size and stiffness: the stability map.

Each cell simulates one rollout without noise and holds its gradient to the truth at the same duration. The truth is
the scene's physical gradient or, where it has none, the gradient of the same program at a much finer step.
Estimators play no part: the gradient is the backend's own at w = 0. Where the motion is linear the growth of the state
is measured as well, so that an instability too slow to show within the rollout is seen all the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from bench import registry
from bench.contracts import Backend, ContactLaw, ForceLaw, Integrator, MechanicalScene, Ops, Trajectory, Unsupported
from bench.grid import Cell, Experiment
from bench.program import Dynamics, Program
from bench.session import Session, reference_backends
from bench.store import Columns

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = Columns.of(
    "first_bad_step", "growth_factor", "spectral_radius", "stiffness_limit", "relative_error", "cosine", "grad_norm", "truth_norm",
    "truth_error", texts=("verdict", "truth"), lists=("state_at_first_bad_step",),
)  # fmt: skip
LIMIT = 10.0
"""Multiple of the initial scale beyond which a state component counts as diverged: 100 times the energy."""
GROWN = 1.1
"""Growth over the rollout of a state that cannot grow, from which it counts as diverged."""
INACCURATE = 0.1
"""Relative error of the gradient above which it counts as wrong."""
FINE_STEPS = 1 << 14
"""Fewest steps of the refined truth; half as many say how far it has converged."""
FINER = 4
"""Fewest of its steps to one of the cell's."""
RESOLVED = INACCURATE / 2
"""Relative change on that last halving above which there is no truth to hold a gradient to."""
NEGLIGIBLE = 1e-9
"""Part of the truth's norm below which one of its components counts as 0."""
NEUTRAL = 1 + 1e-9
"""Spectral radius up to which a step counts as stable, in theory and as measured: 1 and rounding."""
REACH = np.logspace(-3, 4, 141)
"""Values of dt^2 stiffness among which the stability limit is looked for."""


def measure(cell: Cell, session: Session) -> dict[str, Any]:
    """The verdict on one cell; raises :class:`Unsupported` without time steps, step states or a truth."""
    if not isinstance(cell.scene, MechanicalScene):
        raise Unsupported(f"scene {cell.scene.name} has no time steps")
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows becomes a status
        return _measured(cell, cell.scene, session)


def _measured(cell: Cell, scene: MechanicalScene, session: Session) -> dict[str, Any]:
    problem = session.problem(cell)
    theta, still = scene.theta0(), np.zeros((problem.program.n_noise, 1))
    gradient = problem.grad(theta, still)[:, 0]
    found = problem.trajectory(theta, still)
    states, limits = found.states[:, :, 0], bounds(problem.program, found)
    growth = growth_factor(states) if hasattr(scene, "oscillator") else math.nan
    result = {"status": "ok", "grad_norm": float(np.linalg.norm(gradient)), "growth_factor": growth, **theory(cell)}
    bad = first_bad_step(states, limits, growth)
    if bad is not None:
        step, verdict, what = bad
        reason = f"state at step {step} of {scene.horizon} {what}"
        result |= {"status": verdict, "verdict": verdict, "first_bad_step": step, "reason": reason}
        return result | {"state_at_first_bad_step": states[step].tolist()}
    if not np.isfinite(gradient).all():
        return result | {"status": "nonfinite", "verdict": "nonfinite", "reason": "the gradient of a finite rollout"}
    kind, truth, error = truth_of(cell)
    result |= {"truth": kind, "truth_norm": float(np.linalg.norm(truth)), "truth_error": error}
    if not error <= RESOLVED:
        reason = f"halving the finest step moves the truth by {error:.1%}, more than {RESOLVED:.0%}"
        return result | {"verdict": "unresolved", "reason": reason}
    return result | compare(gradient, truth)


# ---------------------------------------------------------------------------------------------- trajectories


def first_bad_step(states: np.ndarray, limits: np.ndarray, growth: float) -> tuple[int, str, str] | None:
    """The first bad step of ``states (T + 1, n)``, whether it ``diverged`` or is ``nonfinite``, and why; None if none is.

    A step is bad when a component is not within its limit ``(n,)``, or when growing by the factor ``growth`` at every
    step has come to GROWN, whichever is first.
    """
    steps = len(states)
    outside = ~(np.abs(states) <= limits).all(axis=1)
    left = int(np.argmax(outside)) if outside.any() else steps
    slow = math.ceil(math.log(GROWN) / math.log(growth)) if growth > NEUTRAL else steps
    step = min(left, slow)
    if step >= steps:
        return None
    if not np.isfinite(states[step]).all():
        return step, "nonfinite", "is not finite"
    if slow < left:
        return step, "diverged", f"has grown by {GROWN - 1:.0%}, {growth - 1:.2g} a step"
    beyond = LIMIT * float((np.abs(states[step]) / limits).max())
    return step, "diverged", f"is {beyond:.3g} times the initial scale"


def growth_factor(states: np.ndarray) -> float:
    """Growth per step of ``states (T + 1, n)`` that one linear map leads through: its spectral radius.

    The map is fitted to all pairs of neighbouring states by least squares, each pair scaled to the size of its first
    state (dynamic mode decomposition; Schmid 2010).
    """
    finite = np.isfinite(states).all(axis=1)
    count = len(states) if finite.all() else int(np.argmin(finite))
    if count < 3:
        return math.nan
    scaled = states[:count] / np.maximum(np.abs(states[:count]).max(axis=0), np.finfo(float).tiny)
    size = np.linalg.norm(scaled[:-1], axis=1, keepdims=True)
    moving = size[:, 0] > 0
    before, after = (part[moving] / size[moving] for part in (scaled[:-1], scaled[1:]))
    fitted = np.linalg.lstsq(before, after, rcond=None)[0]
    return float(np.abs(np.linalg.eigvals(fitted)).max())


def bounds(program: Program, found: Trajectory) -> np.ndarray:
    """LIMIT times the initial scale of each component, ``(n,)``.

    Positions: |q_0| + T |v_0|, how far the start reaches. Velocities: |v_0| + sqrt(|a_0| times that length), the speed
    that the first acceleration gives over it; largest components of each. A scale of 0 counts as 1.
    """
    scene = program.scene
    assert isinstance(scene, MechanicalScene)
    q, v = np.split(found.states[0], [scene.n_q])
    u = found.controls[0]
    a = Dynamics(cast(Ops, SimpleNamespace(xp=np)), scene, program.contact).acceleration(q, v, u)
    speed = float(np.abs(v).max(initial=0.0))
    length = float(np.abs(q).max(initial=0.0)) + scene.horizon * scene.dt * speed
    scales = [length or 1.0, speed + math.sqrt(float(np.abs(a).max(initial=0.0)) * length) or 1.0]
    return LIMIT * np.repeat(scales, [len(q), len(v)])


# ---------------------------------------------------------------------------------------------------- truth


def truth_of(cell: Cell) -> tuple[str, np.ndarray, float]:
    """How the truth was got, the gradient ``(d,)``, and its relative error as far as known."""
    physical = cell.scene.physical_gradient()
    if physical is not None:
        return "physical", np.asarray(physical), 0.0
    assert isinstance(cell.scene, MechanicalScene)
    steps = max(FINE_STEPS, FINER * cell.scene.horizon)
    coarse, fine = _gradient_at(cell, steps // 2), _gradient_at(cell, steps)
    change = float(np.linalg.norm(fine - coarse))
    return "refined", fine, change / float(np.linalg.norm(fine)) if change else 0.0


def _gradient_at(cell: Cell, steps: int) -> np.ndarray:
    """The cell's gradient with its duration cut into that many steps, numerical damping per second kept."""
    scene = cell.scene
    assert isinstance(scene, MechanicalScene)
    dt = scene.horizon * scene.dt / steps
    values: dict[str, Any] = {"horizon": steps, "dt": dt}
    if "velocity_factor" in registry.parameters(type(scene)):
        values["velocity_factor"] = scene.velocity_factor ** (dt / scene.dt)
    fine = replace(scene, **values)
    if fine.theta0().size != scene.theta0().size:
        raise Unsupported(f"theta of scene {scene.name} changes with the horizon, so that no finer step has the truth")
    backend = next(reference_backends(replace(cell, scene=fine)))
    return _gradient(backend, fine, cell.contact, cell.integrator)


@lru_cache(maxsize=64)
def _gradient(
    backend: Backend, scene: MechanicalScene, contact: ContactLaw | None, integrator: Integrator | None
) -> np.ndarray:
    problem = backend.compile(Program(scene, contact, integrator))
    return problem.grad(scene.theta0(), np.zeros((problem.program.n_noise, 1)))[:, 0]


def compare(gradient: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Verdict, relative error and cosine of a finite gradient, the first verdict that holds.

    ``zero``: a component is exactly 0 where the truth's is not. ``wrong_sign``: the directional derivative along the
    truth is negative. ``inaccurate``: off by more than INACCURATE. Otherwise ``ok``.
    """
    norm, size = float(np.linalg.norm(truth)), float(np.linalg.norm(gradient))
    away = float(np.linalg.norm(gradient - truth))
    error = away / norm if norm else math.inf if away else 0.0
    cosine = float(gradient / size @ (truth / norm)) if norm and size else math.nan
    if ((gradient == 0) & (np.abs(truth) > NEGLIGIBLE * norm)).any():
        verdict = "zero"
    elif cosine < 0:
        verdict = "wrong_sign"
    else:
        verdict = "ok" if error <= INACCURATE else "inaccurate"
    return {"verdict": verdict, "relative_error": error, "cosine": cosine}


# --------------------------------------------------------------------------------------------------- theory


def theory(cell: Cell) -> dict[str, float]:
    """Spectral radius of a step on the cell's oscillator, and the stiffness at which it leaves 1.

    The limit is 0 for a step that is never stable and infinite for one that always is. Empty without an oscillator.
    """
    found = oscillator(cell)
    if found is None:
        return {}
    assert cell.integrator is not None
    assert isinstance(cell.scene, MechanicalScene)
    stiffness, damping, factor = found
    dt = float(cell.scene.dt)
    limit = stiffness_limit(cell.integrator, dt, damping, factor)
    radius = spectral_radius(cell.integrator, dt, stiffness, damping, factor)
    return {"spectral_radius": radius, "stiffness_limit": limit * cell.columns()["stiffness"] / stiffness}


def oscillator(cell: Cell) -> tuple[float, float, float] | None:
    """Stiffness [1/s^2] and damping [1/s] per unit of mass and velocity factor of what oscillates in a cell, or None.

    The scene's own ``oscillator()``; else its contact while it lasts, if there is one and a spring law acts in it.
    """
    scene, law = cell.scene, cell.contact
    own = getattr(scene, "oscillator", None)
    if own is not None:
        stiffness, damping, factor = own()
        return float(stiffness), float(damping), float(factor)
    if not isinstance(scene, MechanicalScene) or not isinstance(law, ForceLaw) or scene.n_contacts != 1:
        return None
    start = scene.initial_state(np, scene.theta0()[:, None])
    response = float(scene.gap_rate(np, start.q, scene.contact_acceleration(np, start.q, np.ones((1, 1))))[0, 0])
    stiffness, damping = getattr(law, "stiffness", 0.0), getattr(law, "damping", 0.0)
    return (stiffness * response, damping * response, float(scene.velocity_factor)) if stiffness else None


def spectral_radius(integrator: Integrator, dt: float, stiffness: float, damping: float, factor: float) -> float:
    """Largest modulus of the eigenvalues of one step on the oscillator."""
    matrix = integrator.transition(dt, stiffness, damping, factor)
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def stiffness_limit(integrator: Integrator, dt: float, damping: float, factor: float) -> float:
    """The stiffness [1/s^2] at which the step becomes unstable: 0 if it is from the start, inf if never within REACH."""

    def unstable(reach: float) -> bool:
        return spectral_radius(integrator, dt, reach / dt**2, damping, factor) > NEUTRAL

    first = next((i for i, reach in enumerate(REACH) if unstable(reach)), None)
    if first is None:
        return math.inf
    if first == 0:
        return 0.0
    low, high = REACH[first - 1], REACH[first]
    for _ in range(40):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if unstable(middle) else (middle, high)
    return float(low) / dt**2


def write(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> list[Path]:
    """Heat maps and tables; prints the short one."""
    from bench.report import stability

    return stability.write(experiment, rows, COLUMNS)
