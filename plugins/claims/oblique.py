"""C12: an oblique collision: the velocity after it has its right derivative only from the place of the impact."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import exact_descent, native, plugin
from bench.model import Array, MechanicalScene, State

STEPS, RATE, ITERATIONS = 480, 200.0, 500
OPTIMUM = 0.311417
EVERY = 10
SHARE = 0.03
"""Relative difference allowed between the ends: the source's programs are not described to the last operation."""
CASES = {
    "event": ("impulse", "event_driven", "0.31517"),
    "time": ("impulse", "semi_implicit_euler", "0.39494"),
    "neither": ("impulse[time_of_impact=false]", "semi_implicit_euler", "0.36158"),
}
"""Law, integrator and published end by case."""
LABELS = {"event": "steps from the impact", "time": "time of impact only", "neither": "neither"}


def oblique() -> MechanicalScene:
    """Return the two balls with the first one straight below the second, which it can only graze to hit the goal."""
    base = plugin("scenes", f"two_balls[horizon={STEPS},dt={1.0 / STEPS!r},effort=0.01]")

    class Oblique(type(base)):  # type: ignore[misc]
        name = "oblique_two_balls"

        def theta0(self) -> np.ndarray:
            """Return a force in y of the same size for every step."""
            return np.tile([0.0, self.force], self.horizon)

        def initial_state(self, xp: Any, theta: Array) -> State:
            """Return the balls at rest at (-1, -2) and (-1, -1)."""
            zero = 0.0 * theta[0]
            return State(xp.stack([zero - 1.0, zero - 2.0, zero - 1.0, zero - 1.0]), xp.stack([zero] * 4))

    scene: MechanicalScene = Oblique(**{field.name: getattr(base, field.name) for field in fields(base)})
    return scene


class ObliqueCollision(Claim):
    """Control through an oblique collision."""

    name = "C12"
    lesson = "Time of impact"
    statement = (
        "500 steps of descent through an oblique collision end at .31517, near the optimum .311417, where the velocity's "
        "derivative is corrected too, at .39494 with only the time of impact, and at .36158 with neither."
    )
    source = "Zhong, Han, Brikis 2023, arXiv 2305.00092"
    learned = "Where the normal turns with the place of impact, the right position with a wrong velocity is worse than neither."
    labels = ("iteration", "cost")
    logarithmic = "y"
    curves = LABELS
    marks = (("y", OPTIMUM, "optimum"),)
    quick = False

    def measure(self) -> Outcome:
        """Descend at rate 200 under each program."""
        scene = oblique()
        figures: list[Figure] = []
        series: dict[str, Any] = {"iteration": list(range(0, ITERATIONS + 1, EVERY))}
        for name, (law, integrator, end) in CASES.items():
            at = native(scene, law, integrator)
            series[name] = costs = exact_descent(at, at.program.theta0, RATE, ITERATIONS, EVERY)[1]
            figures.append(Figure(f"cost at the end, {LABELS[name]}", end, costs[-1], spread=SHARE * float(end)))
        # the optimum is a bound: within 3% of it, or 10% above it
        figures.append(
            Figure("end over the optimum, steps from the impact", "1.012", series["event"][-1] / OPTIMUM, spread=0.018)
        )
        return Outcome(
            figures,
            reservation=(
                f"the ends may differ from the source's by {SHARE:.0%}, and so by more than by chance, since its programs are "
                "not the same operations: its corrected derivative is replaced by steps that restart at the impact, and its "
                f"number of time steps is taken from its earlier collision, {STEPS}. The differences between the three ends "
                "are larger"
            ),
            series=series,
        )
