"""A physics engine's twin of a scene beside the scene's own program: one rollout, its cost and its gradient.

What is here called a difference is the model error of the engine's program against the scene's, for the same masses, springs
and step: neither is wrong about its own program. Seconds are those of a batch of ``samples`` rollouts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench import noise, timing
from bench.contracts import MechanicalScene, Problem, Unsupported
from bench.grid import Cell, Experiment, ranked_backends
from bench.session import Session
from bench.store import Columns

if TYPE_CHECKING:
    import pandas as pd

PATHS = ("path", "own_path")
"""Positions along the rollout, ``(horizon + 1) n_q`` numbers: kept for the chart and left out of the table."""
VECTORS = ("gradient", "own_gradient")
COLUMNS = Columns.of(
    "state_difference", "state_difference_rel", "cost", "own_cost", "cost_difference_rel",
    "gradient_norm", "own_gradient_norm", "gradient_difference_rel", "gradient_cosine",
    "value_s", "gradient_s", "trace_s", "lower_s", "compile_s", texts=("own_backend",), lists=VECTORS,
)  # fmt: skip
COLUMNS = replace(COLUMNS, lists=(*VECTORS, *PATHS), extra=PATHS)

TIMED_CALLS = 5


def measure(cell: Cell, session: Session) -> dict[str, Any]:
    """Differences at w = 0, and the seconds of costs and gradients.

    ``state_difference`` is the largest over time and coordinates, positions in their units and velocities in theirs;
    ``_rel`` is in units of the largest value that coordinate takes.
    """
    if "physics" not in cell.backend.provides or not isinstance(cell.scene, MechanicalScene):
        raise Unsupported("has no twin to compare: its steps are the scene's own")
    able = ranked_backends(cell)
    if not able:
        raise Unsupported("has no program of its own to compare with: it runs in physics engines alone")
    twin, own = session.problem(cell), session.problems.of(able[0], cell)
    theta, still = cell.scene.theta0(), np.zeros((twin.program.n_noise, 1))
    path, own_path = (problem.trajectory(theta, still).states[:, :, 0] for problem in (twin, own))
    gradient, own_gradient = (problem.grad(theta, still)[:, 0] for problem in (twin, own))
    cost, own_cost = (float(problem.value(theta, still)[0]) for problem in (twin, own))
    off = np.abs(path - own_path).max(axis=0)
    result = {
        "status": "ok",
        "reason": "",
        "own_backend": able[0].name,
        "state_difference": float(off.max()),
        "state_difference_rel": float((off / np.maximum(np.abs(own_path).max(axis=0), 1e-300)).max()),
        "cost": cost,
        "own_cost": own_cost,
        "cost_difference_rel": abs(cost - own_cost) / abs(own_cost),
        "gradient": gradient.tolist(),
        "own_gradient": own_gradient.tolist(),
        "gradient_norm": float(np.linalg.norm(gradient)),
        "own_gradient_norm": float(np.linalg.norm(own_gradient)),
        "gradient_difference_rel": float(np.linalg.norm(gradient - own_gradient) / np.linalg.norm(own_gradient)),
        "gradient_cosine": float(gradient @ own_gradient / (np.linalg.norm(gradient) * np.linalg.norm(own_gradient))),
        "path": path[:, : cell.scene.n_q].ravel().tolist(),
        "own_path": own_path[:, : cell.scene.n_q].ravel().tolist(),
        **_seconds(cell, twin),
    }
    if not (np.isfinite(path).all() and np.isfinite(gradient).all()):
        result |= {"status": "nonfinite", "reason": "the engine's rollout or its gradient is not finite"}
    return result


def _seconds(cell: Cell, problem: Problem) -> dict[str, float]:
    """Medians over calls with ``samples`` columns, and what the compilation of the gradient took."""
    theta = cell.scene.theta0()
    w = noise.shared(cell.seed, cell.scene.name, 1, cell.samples, problem.program.n_noise)[0].T
    _, value = timing.timed(lambda _: problem.value(theta, w), TIMED_CALLS)
    problem.reset_usage()
    _, gradient = timing.timed(lambda _: problem.grad(theta, w), TIMED_CALLS)
    usage = problem.usage
    return {
        "value_s": value.median_s,
        "gradient_s": gradient.median_s,
        "trace_s": usage.trace_s,
        "lower_s": usage.lower_s,
        "compile_s": usage.compile_s,
    }


def write(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> list[Path]:
    """Table, chart and the printed table."""
    from bench.report import twins

    return twins.write(experiment, rows)
