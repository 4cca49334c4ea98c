"""C18: the distance of first from zeroth order on a throw comes from the damper that acts at first touch, not from stiffness."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import estimator, native, terms

SAMPLES = 80_000
STIFFNESSES = (1e4, 2e4, 3e4, 5e4, 1e5, 2e5)
DISTANCES = {
    320: ("4.48", "9.12", "13.8", "23.2", "47.6", "101.6"),
    288: ("3.39", "6.97", "10.57", "17.86", "36.75", "78.38"),
}
"""By number of steps, the distance at each stiffness, with a damping of a thousandth of it."""
SPREAD = 0.01
"""Relative error of the printed distances, which are means of samples as well."""


class Damper(Claim):
    """First and zeroth order on a throw with a damped penalty."""

    name = "C18"
    lesson = "Stiffness or step size"
    statement = (
        "With a damper of a thousandth of the stiffness, the means of first and zeroth order differ by 3.39 at 1e4 N/m and by "
        "78.4 at 2e5. Without a damper they agree, and at 1e4 a step ten times finer changes nothing: the damper jumps at first touch."
    )
    source = "Zhong, Han, Brikis 2022, task 2; distances by an independent program"
    origin = "recomputed"
    learned = "A stiff contact does not bias the first order; a damper's force, which jumps, does at any step."
    quantity = "distance of first from zeroth order"
    logarithmic = "x"
    quick = False

    def measure(self) -> Outcome:
        """Estimate both means with the same samples."""
        figures, series = [], dict[str, Any]({"stiffness k [N/m]": STIFFNESSES})
        for steps, published in DISTANCES.items():
            series[f"damper of k / 1000, {steps} steps"] = found = [_distance(k, steps) for k in STIFFNESSES]
            figures += [
                Figure(f"distance at {k:.0e} N/m, {steps} steps", text, *distance, spread=SPREAD * float(text))
                for k, text, distance in zip(STIFFNESSES, published, found, strict=True)
            ]
            figures.append(Figure(f"without a damper, {steps} steps", "0.00", *_distance(1e4, steps, 0.0)))
        series["damper of k / 1000, 2,880 finer steps"] = finer = [_distance(k, 2880) for k in STIFFNESSES]
        series["no damper, 288 steps"] = [_distance(k, 288, 0.0) for k in STIFFNESSES]
        figures += [
            Figure("a damper of 30", "9.16", *_distance(1e4, 288, 3e-3), spread=SPREAD * 9.16),
            Figure("a damper of 10, steps ten times finer", "3.36", *finer[0], spread=SPREAD * 3.36),
        ]
        return Outcome(figures, series=series)


def _distance(stiffness: float, steps: int, share: float = 1e-3) -> tuple[float, float]:
    """Return the distance of the means of both orders on a throw, and its standard error; the damping is a share of the stiffness."""
    dt = 0.6 / (288 if steps < 2880 else steps)
    at = native(
        f"ground_wall[sigma=0.1,horizon={steps},dt={dt!r}]",
        f"penalty[stiffness={stiffness!r},damping={share * stiffness!r}]",
    )
    noise = np.random.default_rng(18).standard_normal((2, SAMPLES))
    difference = terms(at, estimator("fobg"), noise) - terms(at, estimator("reinforce[baseline=center]"), noise)
    return float(np.linalg.norm(difference.mean(axis=0))), np.sqrt(difference.var(axis=0, ddof=1).sum() / SAMPLES)
