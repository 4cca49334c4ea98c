"""Compares a physics engine's twin of a scene with the scene's own program: one rollout, its cost and its gradient.

A difference is the model error between two programs with the same masses, springs and step. Each gradient may be exact
for its own program. Times are for a batch of ``samples`` rollouts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import timing
from bench.model import Unsupported, rollout
from bench.studies import finite_status, first_batch, gradient_seconds, norm, relative_error
from bench.studies.twins import Twins


def measure(cell: Cell, session: Session, study: Twins) -> dict[str, Any]:
    """Return one cell's results by column: differences at w = 0, and times of costs and gradients [s].

    ``state_difference`` is the largest difference over time and coordinates, in the units of the coordinate.
    ``state_difference_rel`` is in units of the coordinate's largest value. Raises :class:`Unsupported` if the backend
    has no twin, or the scene no program of its own.
    """
    scene = rollout(cell.program()).scene
    if "physics" not in cell.backend.provides:
        raise Unsupported(f"backend {cell.backend.name} has no twin to compare: its steps are the scene's own")
    if not cell.ranked_backends:
        raise Unsupported(
            f"scene {scene.name} exists only as an engine's model: it has no program of its own to compare with"
        )
    twin, own = session.problem(cell), session.problems.of(cell.ranked_backends[0], cell)
    theta, still = twin.program.theta0, np.zeros((twin.program.n_noise, 1))
    path, own_path = (problem.trajectory(theta, still).states[:, :, 0] for problem in (twin, own))
    gradient, own_gradient = (problem.grad(theta, still)[:, 0] for problem in (twin, own))
    cost, own_cost = (float(problem.value(theta, still)[0]) for problem in (twin, own))
    difference, w = np.abs(path - own_path).max(axis=0), first_batch(cell, len(still))
    return {
        **finite_status("the engine's rollout or its gradient is not finite", path, gradient),
        "own_backend": cell.ranked_backends[0].name,
        "state_difference": float(difference.max()),
        "state_difference_rel": float((difference / np.maximum(np.abs(own_path).max(axis=0), 1e-300)).max()),
        "cost": cost, "own_cost": own_cost, "cost_difference_rel": abs(cost - own_cost) / abs(own_cost),
        "gradient": gradient.tolist(), "own_gradient": own_gradient.tolist(),
        "gradient_norm": norm(gradient), "own_gradient_norm": norm(own_gradient),
        "gradient_difference_rel": relative_error(gradient, own_gradient),
        "gradient_cosine": float(gradient @ own_gradient / (norm(gradient) * norm(own_gradient))),
        "path": path[:, : scene.n_q].ravel().tolist(), "own_path": own_path[:, : scene.n_q].ravel().tolist(),
        "value_s": timing.timed(lambda _: twin.value(theta, w), study.timed_calls)[1].median_s,
        **gradient_seconds(twin, w, study.timed_calls),
        "trace_s": twin.usage.trace_s, "lower_s": twin.usage.lower_s,
    }  # fmt: skip
