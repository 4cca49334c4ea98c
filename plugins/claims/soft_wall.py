"""C14: a soft wall whose gradient is wrong by the step size, not by its stiffness."""

from __future__ import annotations

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import native

PUBLISHED = {0.1: "1.26", 0.05: "0.61", 0.02: "0.145", 0.01: "0.149", 1e-3: "0.012", 1e-4: "4.5e-4"}
STARTS = 40_000
"""Number of starts over which each error is averaged."""
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
    quantity = "mean error of df/dq0"
    logarithmic = "xy"
    marks = (("y", SPEED, "size of the gradient"),)

    def measure(self) -> Outcome:
        """Average the error over starts that are more than 0.05 away from the exact solution's kink."""
        figures, errors = [], []
        # multiples of the golden ratio cover all phases of a step evenly, evenly spaced starts only some phases
        every = np.arange(STARTS) * ((5**0.5 - 1) / 2) % 1.0
        for dt, text in PUBLISHED.items():
            error, less = _mean_error(dt, every), _mean_error(dt, every[: STARTS // 2])
            # numbers of evenly spaced starts that the source may have used: its spread is the largest difference from them
            grids = [_mean_error(dt, np.linspace(0.0, 1.0, count)) for count in (500, 1000, 2000)]
            errors.append(error)
            spread = max(abs(grid - error) for grid in grids)
            figures.append(Figure(f"mean error at a step of {dt:g}", text, error, abs(error - less), spread))
        few = _mean_error(0.02, np.linspace(0.0, 1.0, 149))
        return Outcome(
            figures,
            reservation=(
                "the source does not give its starts, and an average over evenly spaced ones hangs on their number, since they "
                f"meet the same few phases of the step again and again: 149 of them give {few:.3f} at a step of 0.02 s, where "
                f"all phases give {errors[2]:.3f}"
            ),
            series={"time step [s]": list(PUBLISHED), "penalty program": errors},
        )


def _mean_error(dt: float, shares: np.ndarray) -> float:
    """Return the mean error of df/dq0 over starts 0.02 + 1.48 ``shares``, without the starts near the kink."""
    start = 0.02 + 1.48 * shares
    start = start[np.abs(start - KINK) > 0.05]
    truth = np.where(start < KINK, -SPEED, SPEED)
    at = native(f"wall_penalty_1d[dt={dt!r},horizon={round(2 / dt)}]")
    return float(np.abs(at.grad(start[None], np.zeros((1, start.size)))[0] - truth).mean())
