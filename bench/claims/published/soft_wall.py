"""C14: a soft wall whose gradient is wrong by the step size, not by its stiffness."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.claims.claim import Claim, Figure, Outcome
from bench.claims.pieces import centre, native

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PUBLISHED = {0.1: "1.26", 0.05: "0.61", 0.02: "0.145", 0.01: "0.149", 1e-3: "0.012", 1e-4: "4.5e-4"}
STARTS = {0.1: 40_000, 0.05: 40_000, 0.02: 40_000, 0.01: 20_000, 1e-3: 20_000, 1e-4: 8000}
"""Starts over which each error is averaged."""
KINK, SPEED = 0.305149, 0.800354


class SoftWall(Claim):
    """A point and a spring wall."""

    name = "C14"
    lesson = "Stiffness or step size"
    statement = (
        "A penalty wall's gradient is wrong by more than its own size at coarse steps, and right as the step falls."
    )
    source = "Paulus et al. 2025, arXiv 2506.14186, toy example"
    learned = "Before blaming contact, halve the time step and look again."
    labels = ("time step [s]", "mean error of df/dq0")

    def measure(self) -> Outcome:
        """Average the error over starts that are 0.05 away from the physics' kink."""
        figures, errors = [], []
        for dt, text in PUBLISHED.items():
            start = np.linspace(0.02, 1.5, STARTS[dt])
            start = start[np.abs(start - KINK) > 0.05]
            truth = np.where(start < KINK, -SPEED, SPEED)
            still = np.zeros((1, start.size))
            at = native(f"wall_penalty_1d[dt={dt!r},horizon={round(2 / dt)}]")
            # which of the teeth that each step makes a start lies in is chance, and so is the average's last digit
            error, chance = centre(np.abs(at.grad(start[None], still)[0] - truth))
            errors.append(error)
            figures.append(Figure(f"mean error at a step of {dt:g}", text, error, chance))
        return Outcome(figures, series={"dt": list(PUBLISHED), "error": errors})

    def draw(self, axes: Axes, series: Mapping[str, Any]) -> None:
        """Draw the error against the step."""
        axes.loglog(series["dt"], series["error"], "o-", label="penalty program")
        axes.axhline(SPEED, color="#404040", linewidth=0.6, label="size of the gradient")
