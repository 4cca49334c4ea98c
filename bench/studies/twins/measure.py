"""Compares a physics engine's twin of a scene with the scene's own program: one rollout, its cost and its gradient.

A difference is the model error between two programs with the same masses, springs and step. Each gradient may be exact
for its own program. Times are for a batch of ``samples`` rollouts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import noise, timing
from bench.model import Problem, Unsupported, rollout


def measure(cell: Cell, session: Session, timed_calls: int) -> dict[str, Any]:
    """Return one cell's results by column: differences at w = 0, and times of costs and gradients [s].

    ``state_difference`` is the largest difference over time and coordinates, in the units of the coordinate.
    ``state_difference_rel`` is in units of the coordinate's largest value. Raises :class:`Unsupported` if the backend
    has no twin, or the scene no program of its own.
    """
    scene = rollout(cell.program()).scene
    if "physics" not in cell.backend.provides:
        raise Unsupported(f"backend {cell.backend.name} has no twin to compare: its steps are the scene's own")
    backends = cell.ranked_backends
    if not backends:
        raise Unsupported(
            f"scene {scene.name} exists only as an engine's model: it has no program of its own to compare with"
        )
    twin, own = session.problem(cell), session.problems.of(backends[0], cell)
    theta, still = twin.program.theta0, np.zeros((twin.program.n_noise, 1))
    path, own_path = (problem.trajectory(theta, still).states[:, :, 0] for problem in (twin, own))
    gradient, own_gradient = (problem.grad(theta, still)[:, 0] for problem in (twin, own))
    cost, own_cost = (float(problem.value(theta, still)[0]) for problem in (twin, own))
    difference = np.abs(path - own_path).max(axis=0)
    result = {
        "status": "ok",
        "reason": "",
        "own_backend": backends[0].name,
        "state_difference": float(difference.max()),
        "state_difference_rel": float((difference / np.maximum(np.abs(own_path).max(axis=0), 1e-300)).max()),
        "cost": cost,
        "own_cost": own_cost,
        "cost_difference_rel": abs(cost - own_cost) / abs(own_cost),
        "gradient": gradient.tolist(),
        "own_gradient": own_gradient.tolist(),
        "gradient_norm": float(np.linalg.norm(gradient)),
        "own_gradient_norm": float(np.linalg.norm(own_gradient)),
        "gradient_difference_rel": float(np.linalg.norm(gradient - own_gradient) / np.linalg.norm(own_gradient)),
        "gradient_cosine": float(gradient @ own_gradient / (np.linalg.norm(gradient) * np.linalg.norm(own_gradient))),
        "path": path[:, : scene.n_q].ravel().tolist(),
        "own_path": own_path[:, : scene.n_q].ravel().tolist(),
        **_seconds(cell, twin, timed_calls),
    }
    if not (np.isfinite(path).all() and np.isfinite(gradient).all()):
        result |= {"status": "nonfinite", "reason": "the engine's rollout or its gradient is not finite"}
    return result


def _seconds(cell: Cell, problem: Problem, timed_calls: int) -> dict[str, float]:
    """Return median times [s] of costs and gradients of ``samples`` rollouts, and the time [s] to compile the gradient."""
    theta = problem.program.theta0
    w = noise.shared(cell.seed, cell.scene.name, 1, cell.samples, problem.program.n_noise)[0].T
    _, value = timing.timed(lambda _: problem.value(theta, w), timed_calls)
    problem.reset_usage()
    _, gradient = timing.timed(lambda _: problem.grad(theta, w), timed_calls)
    usage = problem.usage
    return {
        "value_s": value.median_s,
        "gradient_s": gradient.median_s,
        "trace_s": usage.trace_s,
        "lower_s": usage.lower_s,
        "compile_s": usage.compile_s,
    }
