"""Traces one rollout step by step: contacts, step Jacobians and adjoints.

A :class:`Trace` shows where gradients explode. It has a row for every state of the rollout, and reports whether the
largest changes of |dF/dx| or |dL/dx| coincide with steps at which a contact is made or lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from bench.errors import UserError
from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.grid import cells
from bench.experiment.reference_backends import backends_with_jacobians
from bench.host.identity import label
from bench.measure import noise
from bench.model import (
    Jacobians,
    LoopOps,
    MechanicalScene,
    Problem,
    Program,
    Slopes,
    Unsupported,
    by_actions,
    by_theta,
    rollout,
    slopes_along,
)
from bench.run.session import RunSession
from bench.trace import sentences
from bench.trace.contacts import contact_columns

COLUMNS = (
    "step",
    "time",
    "contacts",
    "switch",
    "gap",
    "penetration",
    "force",
    "force_peak",
    "sticking",
    "slipping",
    "jacobian_norm",
    "adjoint_norm",
    "cost_stage",
    "cost_terminal",
)
"""Columns of every trace. Cost terms (``cost_NAME``), states (``q1``, ``v1``) and controls (``u1``) follow."""
AXES = ("scene", "contact", "integrator", "backend")
"""The axes of a cell that determine its rollout; a trace needs no estimator."""


@dataclass(frozen=True)
class Trace:
    """One rollout, step by step."""

    scene: str
    title: str
    """Scene, contact law, integrator, backend and noise."""
    table: pd.DataFrame
    """``horizon + 1`` rows, one per state; NaN where a quantity does not exist, such as |dF/dx| at the last state."""
    gradient_error: float
    """|adjoints' gradient - program's gradient| / |program's gradient|; absolute if the program's gradient is 0.

    NaN where theta names parameters of the scene.
    """

    def report(self) -> list[str]:
        """Describe the trace in sentences."""
        return sentences.report(self.table, self.gradient_error)


def run(experiment: Experiment, seeded: bool) -> list[Trace]:
    """Return one trace for each scene of the experiment.

    The noise is w = 0, or with ``seeded`` the first sample of the first repeat that estimators get from the cell's
    seed. Raises :class:`UserError` for a scene without a rollout, for several rollouts of one scene, and for a backend
    without step Jacobians.
    """
    session = RunSession(experiment)
    return [_of_cell(session, cell, seeded) for cell in _chosen(experiment)]


def _chosen(experiment: Experiment) -> list[Cell]:
    """Return one cell for each scene; raises :class:`UserError` if a scene has several rollouts."""
    unique: dict[str, dict[Any, Cell]] = {}
    for cell in cells(experiment):
        rollouts = unique.setdefault(cell.scene.name, {})
        rollouts.setdefault((*(cell.parts.get(axis) for axis in AXES), cell.seed), cell)
    for name, rollouts in unique.items():
        if len(rollouts) > 1:
            raise UserError(
                f"a trace follows one rollout, and there are {len(rollouts)} problems of scene {name}: choose one "
                "contact law, integrator, backend and seed, and sweep nothing"
            )
    return [cell for rollouts in unique.values() for cell in rollouts.values()]


def _of_cell(session: RunSession, cell: Cell, seeded: bool) -> Trace:
    scene = cell.scene
    if not isinstance(scene, MechanicalScene):
        raise UserError(f"scene {scene.name} is a plain function: it has no steps to trace")
    try:
        program = cell.program()
    except Unsupported as error:
        raise UserError(f"{scene.name} cannot be traced: {error}") from None
    refusal = cell.with_part("estimator", None).refusal()
    if refusal is not None:
        raise _cannot(cell, program, refusal[1])
    w = np.zeros((program.n_noise, 1))
    if seeded:
        # "cells" is the stream of the estimators, so the trace shows one of their samples
        w = noise.draw(cell.seed, scene.name, 1, 1, program.n_noise, "cells")[0].T
    try:
        table, gradient_error = trace(session.problem(cell), w)
    except Unsupported as reason:
        raise _cannot(cell, program, str(reason)) from None
    parts = [label(part) for axis in AXES if (part := cell.parts[axis]) is not None]
    drawn = f"noise of seed {cell.seed}" if seeded else "w = 0"
    return Trace(scene.name, ", ".join([*parts, drawn]), table, gradient_error)


def _cannot(cell: Cell, program: Program, reason: str) -> UserError:
    """Return an error that states why a cell cannot be traced, and which backends can trace its program."""
    able = sorted(name for name in backends_with_jacobians(program) if name != cell.backend.name)
    hint = f"; use backends=[{'] or backends=['.join(able)}]" if able else ""
    return UserError(f"{cell.scene.name} on backend {cell.backend.name} cannot be traced: {reason}{hint}")


def trace(problem: Problem, w: np.ndarray) -> tuple[pd.DataFrame, float]:
    """Return the table of the rollout at ``theta0`` with noise ``w (n_w, 1)``, and the error of the adjoints' gradient.

    Raises :class:`Unsupported` for plain functions, and for backends without step Jacobians.
    """
    program = rollout(problem.program)
    theta = program.theta0
    steps = problem.jacobians(theta, w)
    path = Jacobians(*(part[..., 0] for part in steps))
    bound, own, noise_left = program.resolved(LoopOps(), theta[:, None], w)
    scene = bound.scene
    with np.errstate(all="ignore"):
        adjoint, gradient_error = _adjoints(problem, slopes_along(bound, steps, own, noise_left), w)
        columns = {**contact_columns(problem, bound, path), **_costs(scene, path)}
        columns["jacobian_norm"] = per_state(_norms(path.a))
        columns["adjoint_norm"] = np.linalg.norm(adjoint, axis=1)
    columns["step"] = np.arange(scene.horizon + 1)
    columns["time"] = columns["step"] * scene.dt
    parts = {"q": path.states[:, : scene.n_q], "v": path.states[:, scene.n_q :], "u": path.controls}
    named = {f"{letter}{i}": values for letter, part in parts.items() for i, values in enumerate(part.T, 1)}
    columns |= {name: values if len(values) > scene.horizon else per_state(values) for name, values in named.items()}
    return pd.DataFrame({name: columns[name] for name in dict.fromkeys((*COLUMNS, *columns))}), gradient_error


def per_state(values: Any) -> np.ndarray:
    """Return values of the steps ``(T,)`` extended to the states, ``(T + 1,)``, with NaN for the last state."""
    return np.append(np.asarray(values, dtype=np.float64), np.nan)


def _adjoints(problem: Problem, path: Slopes, w: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the adjoints dL/dx_k, ``(T + 1, k)``, and the error of the gradient that follows from them."""
    kept = list(path.cost_x)

    def keep(t: int, state: np.ndarray, adjoint: np.ndarray) -> np.ndarray:
        kept[t] = adjoint
        return adjoint

    by_control, kept[0] = by_actions(path, keep)
    adjoint = np.stack(kept)[..., 0]
    if problem.program.decision.names:  # theta moves the steps themselves, beside their states
        return adjoint, math.nan
    gradient, expected = by_theta(problem, path, by_control, kept[0]), problem.grad(problem.program.theta0, w)
    return adjoint, float(np.linalg.norm(gradient - expected)) / (float(np.linalg.norm(expected)) or 1.0)


def _norms(matrices: np.ndarray) -> np.ndarray:
    """Return spectral norms of ``(T, n, n)``; inf where an entry is not finite, which LAPACK rejects."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    norms = np.full(len(matrices), np.inf)
    norms[finite] = np.linalg.norm(matrices[finite], 2, axis=(1, 2))
    return norms


def _costs(scene: MechanicalScene, path: Jacobians) -> dict[str, np.ndarray]:
    """Return costs by column, each ``(T + 1,)``: stage costs and terms per step, the terminal cost at the last state."""
    states, u = path.states.T, path.controls.T
    before = scene.split(states[:, :-1])

    def staged(value: Any) -> np.ndarray:
        return per_state(np.broadcast_to(value, u.shape[1]))

    terms = {"stage": staged(scene.stage_cost(np, *before, u))}
    terms["terminal"] = np.full(states.shape[1], np.nan)
    terms["terminal"][-1] = scene.terminal_cost(np, *scene.split(states[:, -1:]))[0]
    terms |= {name: staged(value) for name, value in scene.cost_terms(np, *before, u).items()}
    return {f"cost_{name}": values for name, values in terms.items()}
