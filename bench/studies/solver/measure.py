"""Compares a gradient with the gradient of the program whose constraint solver has converged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.studies import finite_status, first_batch, gradient_seconds, norm, relative_error
from bench.studies.solver import Solver

ROUNDING = 1e-6
"""Share of the gradient's norm up to which a coordinate of the converged gradient has no sign."""


def measure(cell: Cell, session: Session, study: Solver) -> dict[str, Any]:
    """Return one cell's results by column: errors to the converged program at w = 0, and times [s]."""
    backend: Any = cell.backend
    problem, limit = session.problem(cell), session.problems.of(replace(backend, iterations=study.converged), cell)
    w = first_batch(cell, problem.program.n_noise)
    # both batches have the same shape, so that each program is compiled once
    gradient, target = (one.grad(problem.program.theta0, np.zeros_like(w))[:, 0] for one in (problem, limit))
    return {
        **finite_status("a gradient is not finite", gradient, target), "iterations": backend.iterations,
        "gradient": gradient.tolist(), "converged_gradient": target.tolist(),
        **gradient_seconds(problem, w, study.timed_calls), **compare(gradient, target),
    }  # fmt: skip


def compare(gradient: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """Return norms, relative error, cosine, and the share of wrong signs among coordinates of ``target`` with a sign."""
    has_sign = np.abs(target) > ROUNDING * norm(target)
    return {
        "gradient_norm": norm(gradient), "converged_norm": norm(target),
        "gradient_error_rel": relative_error(gradient, target),
        "gradient_cosine": float(gradient @ target) / (norm(gradient) * norm(target)),
        "wrong_signs": float((np.sign(gradient) != np.sign(target))[has_sign].mean()),
    }  # fmt: skip
