"""E1: with one iteration of the contact solver, an engine's gradient on a robot has the other sign."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.claims.claim import Claim, Figure, Outcome
from bench.claims.toolkit import problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ANKLE = 1
"""The coordinate of theta: the torque of a front leg's ankle."""
ITERATIONS = (1, 2, 3, 4, 6, 10)


class SolverIterations(Claim):
    """A robot with four legs lands on the ground with friction, at the engines' usual impedance of 0.9."""

    name = "E1"
    lesson = "Solver iterations"
    statement = "With one iteration of the contact solver, which MJX's reverse mode needs, a robot's gradient has the other sign."
    source = "this project, docs/engines.md"
    learned = (
        "A gradient can be exact for a solver that stopped early. Differentiate through the converged solution instead."
    )
    quick = False
    labels = ("iterations of the contact solver", "d(-x) / d(ankle torque) [m/(N m)]")

    def measure(self) -> Outcome:
        """Compute one derivative by chained differences of MuJoCo's steps, along the iterations of its solver."""
        slopes = [
            _slope(f"mujoco[impedance=0.9,iterations={iterations},ls_iterations={4 if iterations == 1 else 50}]")
            for iterations in ITERATIONS
        ]
        figures = [
            Figure("iterations=1", "-0.003658", slopes[0]),
            Figure("iterations=10", "0.003351", slopes[-1]),
        ]
        return Outcome(figures, series={"iterations": list(ITERATIONS), "slope": slopes})

    def draw(self, axes: Axes, series: Mapping[str, Any]) -> None:
        """Draw the derivative along the iterations."""
        axes.axhline(0.0, color="grey", linewidth=0.7)
        axes.plot(series["iterations"], series["slope"], marker="o")
        axes.set_xscale("log")


def _slope(backend: str) -> float:
    """Return the derivative of minus the ant's forward position after 30 steps by an ankle's torque."""
    ant = problem("ant[horizon=30]", backend=backend)
    return float(ant.grad(ant.program.theta0, np.zeros((ant.program.n_noise, 1)))[ANKLE, 0])
