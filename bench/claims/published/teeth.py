"""L3: a bounce without the time of impact: the slope is wrong on every tooth of a nearly right curve."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.claims.claim import Claim, Figure, Outcome
from bench.claims.toolkit import problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TOOTH = 40
"""Number of starts over which the impact moves by one step: 2 m/s times 2 ms."""


class Teeth(Claim):
    """A bouncing ball over small shifts of its start."""

    name = "L3"
    lesson = "Time of impact"
    statement = "A ball's final height falls with its initial one, slope -1; without the time of impact every tooth rises, slope +1."
    source = "Hu et al. 2020, DiffTaichi, ICLR"
    learned = "Plot the cost along a line before trusting its gradient: the teeth are visible at once."
    labels = ("shift of the start [m]", "final height [m]")

    def measure(self) -> Outcome:
        """Evaluate heights and slopes over ten teeth."""
        # half a start off the boundaries between steps
        shift = (np.arange(-5 * TOOTH, 5 * TOOTH) + 0.5) * 0.004 / TOOTH
        theta = np.stack([0.5 + shift, np.full_like(shift, -2.0), np.zeros_like(shift)])
        still = np.zeros((3, shift.size))
        figures, series = [], {"shift": shift.tolist()}
        for name, law, slope in (
            ("with", "impulse", "-1.0000"),
            ("without", "impulse[time_of_impact=false]", "1.0000"),
        ):
            # 204 states are 203 steps
            at = problem("bounce_once[horizon=203,dt=0.002,radius=0.1,height=0.5]", law)
            slopes = at.grad(theta, still)[0]
            height = at.value(theta, still)
            series[name] = height.tolist()
            figures.append(Figure(f"mean slope, {name}", slope, float(slopes.mean())))
            figures.append(
                Figure(
                    f"share of slopes that are {slope}, {name}",
                    "1.0000",
                    float(np.mean(np.abs(slopes - float(slope)) < 1e-9)),
                )
            )
            if name == "with":
                figures.append(Figure("y_T + y0", "1.012", float(np.mean(height + theta[0]))))
            else:
                # starts that are one step's travel apart are at the same position within their teeth
                trend = float(np.mean(height[TOOTH:] - height[:-TOOTH]) / (shift[TOOTH] - shift[0]))
                figures.append(Figure("trend of the teeth", "-1.000", trend))
        return Outcome(figures, series=series)

    def draw(self, axes: Axes, series: Mapping[str, Any]) -> None:
        """Draw both curves."""
        axes.plot(series["shift"], series["with"], label="with time of impact")
        axes.plot(series["shift"], series["without"], linewidth=0.7, label="without")
