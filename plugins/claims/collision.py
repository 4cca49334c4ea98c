"""C11: pushing one ball so that it strikes another: without the time of impact, descent learns to avoid contact."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import exact_descent, native

FITTED = 1e4
"""The penalty stiffness whose descent ends where the source's descent ends [N/m]."""
TRIED = (1e2, 1e3, 3e3, FITTED, 3e4, 1e5)
"""All tested stiffnesses [N/m]."""
LABELS = {"with": "with time of impact", "without": "without", "penalty": "penalty"}


class Collision(Claim):
    """Control through a collision."""

    name = "C11"
    lesson = "Time of impact"
    statement = (
        "1,000 steps of descent through a collision end at 1.3958 with the time of impact, at 1.6694 with a penalty, at 2.0014 "
        "without, where doing nothing costs 2."
    )
    source = "Zhong, Han, Brikis 2022, arXiv 2207.05060, task 3"
    learned = "With the wrong sign at the impact the optimiser learns not to touch: it gives up."
    labels = ("iteration", "cost")
    curves = LABELS
    marks = (("y", 2.0, "doing nothing"),)
    quick = False

    def measure(self) -> Outcome:
        """Descend at rate 10 under each law."""
        cases = (
            ("with", "impulse", "1.395808"),
            ("without", "impulse[time_of_impact=false]", "2.001432"),
            ("penalty", f"penalty[stiffness={FITTED!r}]", "1.6694"),
        )
        figures: list[Figure] = []
        series: dict[str, Any] = {"iteration": list(range(0, 1001, 20))}
        for name, law, loss in cases:
            series[name] = _costs(law)
            figures.append(Figure(f"cost at the end, {name}", loss, float(series[name][-1])))
        tried = {k: float(_costs(f"penalty[stiffness={k!r}]")[-1]) for k in TRIED}
        ends = ", ".join(f"{end:.4f} at {k:g}" for k, end in tried.items())
        last = series["penalty"][-5:]
        return Outcome(
            figures,
            reservation=(
                f"the source does not give its penalty's stiffness: {FITTED:g} N/m is the one of {len(tried)} tried that agrees, "
                f"so that the penalty's figure is partly a fit and decides less than the other two. The descents end at {ends}. "
                f"At {FITTED:g} it does not settle: over the last 80 steps its cost is between {min(last):.3f} and {max(last):.3f}, "
                "so that an end that agrees in four digits is hardly chance"
            ),
            series=series | {"stiffness": list(tried), "end": list(tried.values())},
        )


def _costs(law: str) -> np.ndarray:
    """Return the costs of every 20th of 1,000 steps of descent."""
    at = native("two_balls[horizon=480,dt=0.0020833333333333333]", law)
    return exact_descent(at, np.full(960, 3.0), 10.0, 1000, 20)[1]
