"""C13: an elastic pair on a line: with the time of impact the balls exchange their derivatives, without it they keep them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import problem
from bench.model import Array, ContactScene, State, param

NAMES = ("x1", "x2", "v1", "v2")


@dataclass(frozen=True)
class Pair(ContactScene):
    """Two equal balls of radius .1 on a line; theta = (x1, x2, v1, v2); f is the place of the second ball at the end."""

    name = "pair"
    n_q: ClassVar[int] = 2
    n_contacts: ClassVar[int] = 1
    continuous: ClassVar[bool] = True
    horizon: int = param(100, "steps", positive=True)
    dt: float = param(0.01, "step", "s", positive=True)

    def theta0(self) -> np.ndarray:
        """Return the start: the first ball moves towards the second, which rests."""
        return np.array([0.0, 0.52, 1.0, 0.0])

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return places and velocities."""
        return State(theta[:2], theta[2:])

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Return 0."""
        return 0.0 * q

    def gap(self, xp: Any, q: Array) -> Array:
        """Return the distance of the surfaces."""
        return q[1:] - q[:1] - 0.2

    def gap_rate(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the relative velocity."""
        return v[1:] - v[:1]

    def contact_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        """Return opposite accelerations of the unit masses."""
        return xp.concat([-force, force], axis=0)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the place of the second ball."""
        return q[1]


class ElasticPair(Claim):
    """An elastic collision on a line."""

    name = "C13"
    lesson = "Time of impact"
    statement = (
        "After an elastic collision of equal balls on a line the second ball's end depends on the first ball's start only: "
        "(1, 0, 1, 0) by (x1, x2, v1, v2). Without the time of impact the program has (0, 1, .69, .31), with it the physics."
    )
    source = "nimblephysics, issue 97"
    learned = "A program can end at the right place with the derivatives of the wrong ball."
    quantity = "end of the second ball [m]"

    def measure(self) -> Outcome:
        """Differentiate the end under the impulse law with and without the time of impact, and under event-driven steps."""
        right, wrong = ("1.00", "0.00", "1.00", "0.00"), ("0.00", "1.00", "0.69", "0.31")
        cases = {
            "with time of impact": ("impulse", "semi_implicit_euler", right),
            "without": ("impulse[time_of_impact=false]", "semi_implicit_euler", wrong),
            "event driven": ("impulse", "event_driven", right),
        }
        figures: list[Figure] = []
        starts = np.linspace(-0.02, 0.02, 97)
        curves: dict[str, Any] = {}
        for label, (law, integrator, published) in cases.items():
            at = problem(Pair(), law, integrator=integrator)
            still = np.zeros((at.program.n_noise, 1))
            slopes = at.grad(at.program.theta0, still)[:, 0]
            figures += [
                Figure(f"by {name}, {label}", text, float(slope), spread=0.005 if label == "without" else 1e-9)
                for name, text, slope in zip(NAMES, published, slopes, strict=True)
            ]
            if label != "without":
                end = float(at.value(at.program.theta0, still)[0])
                figures.append(Figure(f"place at the end, {label}", "1.200", end, spread=1e-9))
            for ball, name in enumerate(("first", "second") if integrator != "event_driven" else ()):
                theta = at.program.theta0[:, None] + np.eye(4)[:, [ball]] * starts
                curve = at.value(theta, np.repeat(still, starts.size, axis=1))
                curves[f"{name} ball: {label}, slope {slopes[ball]:.0f}"] = curve
        return Outcome(figures, series={"shift of the start of this ball [m]": starts} | dict(sorted(curves.items())))
