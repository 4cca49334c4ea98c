"""Compares a gradient with the gradient of the program whose constraint solver has converged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import noise, timing

ROUNDING = 1e-6
"""Share of the gradient's norm up to which a coordinate of the converged gradient has no sign."""


def measure(cell: Cell, session: Session, converged: int, timed_calls: int) -> dict[str, Any]:
    """Return one cell's results by column: errors to the program with ``converged`` iterations, and times [s]."""
    backend: Any = cell.backend
    problem, limit = session.problem(cell), session.problems.of(replace(backend, iterations=converged), cell)
    theta = problem.program.theta0
    w = noise.shared(cell.seed, cell.scene.name, 1, cell.samples, problem.program.n_noise)[0].T
    # both batches have the same shape, so that each program is compiled once
    still = np.zeros_like(w)
    gradient, target = (one.grad(theta, still)[:, 0] for one in (problem, limit))
    problem.reset_usage()
    _, clock = timing.timed(lambda _: problem.grad(theta, w), timed_calls)
    result = {
        "status": "ok",
        "reason": "",
        "iterations": backend.iterations,
        "gradient": gradient.tolist(),
        "converged_gradient": target.tolist(),
        "gradient_s": clock.median_s,
        "compile_s": problem.usage.compile_s,
        **compare(gradient, target),
    }
    if not np.isfinite([gradient, target]).all():
        result |= {"status": "nonfinite", "reason": "a gradient is not finite"}
    return result


def compare(gradient: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """Return norms, relative error, cosine, and the share of wrong signs among coordinates of ``target`` with a sign."""
    norm, target_norm = float(np.linalg.norm(gradient)), float(np.linalg.norm(target))
    has_sign = np.abs(target) > ROUNDING * target_norm
    return {
        "gradient_norm": norm,
        "converged_norm": target_norm,
        "gradient_error_rel": float(np.linalg.norm(gradient - target)) / target_norm,
        "gradient_cosine": float(gradient @ target) / (norm * target_norm),
        "wrong_signs": float((np.sign(gradient) != np.sign(target))[has_sign].mean()),
    }
