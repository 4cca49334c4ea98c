"""C10 to C12: descents through contacts: with the time of impact, without it, and with a penalty."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import exact_descent, native, plugin
from bench.model import Array, MechanicalScene, State

LAWS = {
    "with time of impact": "impulse",
    "without it: wrong gradient": "impulse[time_of_impact=false]",
    "penalty": "penalty",
}
EVERY = {"iteration": list(range(0, 1001, 20))}
SINGLE = 2 * 2.0**-24 * math.sqrt(288)
"""Relative rounding error of position and velocity over 288 steps in single precision, as in the published ends of C10."""
FITTED = 1e4
"""The penalty stiffness of C11 whose descent ends where the source's descent ends [N/m]."""
STEPS, OPTIMUM = 480, 0.311417
SHARE = 0.03
"""Relative difference allowed between the ends of C12: the source's programs are not described to the last operation."""
CASES = {
    "steps from the impact": ("impulse", "event_driven", "0.31517"),
    "time of impact only": ("impulse", "semi_implicit_euler", "0.39494"),
    "neither": ("impulse[time_of_impact=false]", "semi_implicit_euler", "0.36158"),
}
"""Law, integrator and published end of C12 by case."""


class Throw(Claim):
    """A thrown ball."""

    name = "C10"
    lesson = "Time of impact"
    statement = (
        "1,000 steps of descent on a throw end at a loss of 7.8e-5 with the time of impact, .00425 without, 7e-12 with a "
        "penalty."
    )
    source = "Zhong, Han, Brikis 2022, arXiv 2207.05060, task 2"
    learned = "A wrong gradient can still find a way, but a worse one; a penalty, which moves otherwise, can find a better one."
    quantity = "squared distance to the target [m^2]"
    logarithmic = "y"
    quick = False

    def measure(self) -> Outcome:
        """Descend under three laws."""
        published = (
            ("7.8e-5", "10.184146", "-4.160555"),
            ("0.00425", "-2.493337", "-4.298402"),
            ("7e-12", "10.638576", "-4.282096"),
        )
        figures: list[Figure] = []
        series: dict[str, Any] = dict(EVERY)
        for (label, law), (loss, *ends) in zip(LAWS.items(), published, strict=True):
            end, series[label] = exact_descent(native("ground_wall", law), np.array([5.0, -5.0]), 0.01, 1000, 20)
            name = label.partition(" ")[0]
            figures.append(Figure(f"loss at the end, {name}", loss, float(series[label][-1])))
            for part, text, x in zip(("vx", "vy"), ends, end, strict=True):
                figures.append(Figure(f"{part} at the end, {name}", text, float(x), spread=SINGLE * np.abs(end).max()))
        return Outcome(figures, series=series)


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
    quantity = "cost"
    marks = (("y", 2.0, "doing nothing"),)
    quick = False

    def measure(self) -> Outcome:
        """Descend at rate 10 under each law."""
        laws = LAWS | {"penalty": f"penalty[stiffness={FITTED!r}]"}
        series: dict[str, Any] = {label: _costs(law) for label, law in laws.items()}
        figures = [
            Figure(f"cost at the end, {label.partition(' ')[0]}", loss, float(series[label][-1]))
            for label, loss in zip(LAWS, ("1.395808", "2.001432", "1.6694"), strict=True)
        ]
        tried = {k: float(_costs(f"penalty[stiffness={k!r}]")[-1]) for k in (1e2, 1e3, 3e3, FITTED, 3e4, 1e5)}
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
            series=EVERY | series,
        )


def _costs(law: str) -> np.ndarray:
    """Return the costs of every 20th of 1,000 steps of descent."""
    at = native("two_balls[horizon=480,dt=0.0020833333333333333]", law)
    return exact_descent(at, np.full(960, 3.0), 10.0, 1000, 20)[1]


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
    learned = "Where the normal turns with the place of impact, the right position with a wrong velocity (time of impact only) is worse than neither."
    quantity = "cost"
    logarithmic = "y"
    marks = (("y", OPTIMUM, "optimum"),)
    quick = False

    def measure(self) -> Outcome:
        """Descend at rate 200 under each program."""
        scene = oblique()
        figures: list[Figure] = []
        series: dict[str, Any] = {"iteration": list(range(0, 501, 10))}
        for label, (law, integrator, end) in CASES.items():
            at = native(scene, law, integrator)
            series[label] = costs = exact_descent(at, at.program.theta0, 200.0, 500, 10)[1]
            figures.append(Figure(f"cost at the end, {label}", end, costs[-1], spread=SHARE * float(end)))
        # the optimum is a bound: within 3% of it, or 10% above it
        figures.append(
            Figure(
                "end over the optimum, steps from the impact",
                "1.012",
                series["steps from the impact"][-1] / OPTIMUM,
                spread=0.018,
            )
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
