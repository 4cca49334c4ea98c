"""C8 and C9: one bounce: the time of impact decides the gradient's sign, and a penalty's gradient depends on the step."""

from __future__ import annotations

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import problem

SOURCE = "Zhong, Han, Brikis 2022, arXiv 2207.05060, task 1"
NAMES = ("df/dy0", "df/dvy0", "df/du0")


def _starts(height: np.ndarray | float) -> np.ndarray:
    """Return the source's start, at other heights."""
    return np.stack([height, np.full_like(height, -2.0), np.zeros_like(height)])


class TimeOfImpact(Claim):
    """A rigid bounce with and without the time of impact."""

    name = "C8"
    lesson = "Time of impact"
    statement = (
        "A rigid bounce differentiated with the time of impact gives (-1, -1, -.0021); without it (1, -.09583, -.0002): the "
        "sign is wrong at every step size."
    )
    source = SOURCE
    learned = "A motion that is right to first order can have a derivative of the wrong sign. Refining does not help."
    quantity = "final height [m]"

    def measure(self) -> Outcome:
        """Differentiate both programs away from the boundary between steps, and around the source's start."""
        still = np.zeros((3, 1))
        step = 1 / 480
        heights = np.linspace(1 - 4 * step, 1 + 8 * step, 97)
        figures, series = [], {"initial height [m]": heights}
        cases = (
            ("with", " time of impact: slope -1", "impulse", ("-1.000", "-1.000", "-0.0021")),
            ("without", ": slope +1 on every tooth", "impulse[time_of_impact=false]", ("1.000", "-0.09583", "-0.0002")),
        )
        for name, more, law, exact in cases:
            at = problem("bounce_once", law)
            # 1 + 1/480 is half way between two boundaries; a start 2/480 m higher meets the ground one step later
            off, late = (at.grad(_starts(1 + n * step), still)[:, 0] for n in (1, 3))
            figures += [
                Figure(f"{part}, {name}", text, float(x)) for part, text, x in zip(NAMES, exact, late, strict=True)
            ]
            series[name + more] = at.value(_starts(heights), np.zeros((3, heights.size)))
        return Outcome(
            figures,
            reservation=(
                "the source's start is exactly on a boundary between two steps. Its df/dvy0 without the time of impact is that "
                f"of an impact one step later, {late[1]:.5f}; half a step off the boundary it is {off[1]:.5f} here. By hand it is "
                f"2 n / 480 - 1 for an impact in step n: {2 * 217 / 480 - 1:.5f} for 217, {2 * 216 / 480 - 1:.5f} for 216"
            ),
            series=series,
        )


class PenaltyPhase(Claim):
    """A penalty bounce over all phases of the step."""

    name = "C9"
    lesson = "Stiffness or step size"
    statement = "A penalty bounce's gradient error grows with stiffness, and falls a hundredfold with the step."
    source = f"{SOURCE}; recomputed over 256 phases"
    learned = "A hundredth of the step has the same error at a hundred times the stiffness: what counts is stiffness times step."
    origin = "recomputed"
    quantity = "RMS of df/dy0 + 1"
    logarithmic = "xy"
    quick = False

    def measure(self) -> Outcome:
        """Compute the root mean square error over 256 starts within the distance of one step."""
        stiffnesses = [1e2, 1e3, 1e4, 1e5]
        figures, series = [], {"stiffness times step [N s/m]": np.geomspace(1e2, 1e7, 6) / 48000}
        printed = {480: ("0.020", "0.439", "2.37", "55.5"), 48000: ("2.3e-4", "0.0046", "0.0199", "0.391")}
        for parts, published in printed.items():
            errors = []
            heights = 1.0 + 2.0 / parts * np.arange(256) / 256
            for k, text in zip(stiffnesses, published, strict=True):
                scene = f"bounce_once[horizon={parts},dt={1 / parts!r}]"
                at = problem(scene, f"penalty[stiffness={k!r}]", backend="jax[mode=forward]")
                slope = at.grad(_starts(heights), np.zeros((3, 256)))[0]
                errors.append(float(np.sqrt(np.mean((slope + 1) ** 2))))
                figures.append(Figure(f"k = {k:g}, dt = 1/{parts}", text, errors[-1]))
            # a hundredth of the step has the same places at a hundred times the stiffness
            series[f"dt = 1/{parts} s"] = np.roll([*errors, np.nan, np.nan], 2 * (parts == 480))
        return Outcome(figures, series=series)
