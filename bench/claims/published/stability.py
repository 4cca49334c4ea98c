"""C23: every integrator changes the energy and the frequency of an oscillator as its stability function states."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.claims.claim import Claim, Figure, Outcome
from bench.claims.toolkit import problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEPS = 100
EXACT = 1e-6
"""Rounding of the figures, which have closed forms. Implicit steps are solved to 1e-12."""
ENERGIES = {
    "explicit_euler": (0.1, "2.705", "jax"),
    "implicit_euler": (0.1, "0.3697", "implicit"),
    "midpoint": (0.5, "4.713", "jax"),
    "rk4": (1.0, "0.2944", "jax"),
    "implicit_midpoint": (0.5, "1.0000", "implicit"),
}
"""Step, |R(ih)|^200 and backend. R(z) is 1 + z, 1 / (1 - z), 1 + z + z^2 / 2, the same to z^4 / 24, and
(1 + z / 2) / (1 - z / 2)."""
PLACES = {
    "implicit_midpoint": (0.5, "0.08792", "implicit"),
    "stormer_verlet": (0.5, "0.9286", "jax"),
    "semi_implicit_euler": (0.5, "0.8003", "jax"),
}
"""Step, squared place after 100 steps from 1 at rest, and backend. A step turns by 2 atan(h / 2), or by
arccos(1 - h^2 / 2)."""


class Integrators(Claim):
    """Stability functions on an oscillator."""

    name = "C23"
    lesson = "Stiffness or step size"
    statement = (
        "On an oscillator, explicit Euler multiplies the energy by 1 + h^2 in each step and implicit Euler divides it by the "
        "same. The implicit midpoint rule keeps it, Runge-Kutta methods change it by a high power of h, and the symplectic "
        "methods have the wrong frequency only."
    )
    source = (
        "Hairer, Lubich, Wanner 2006, Geometric Numerical Integration, sections I.1 and IX.1; Hairer, Wanner 1996, IV.2"
    )
    learned = "A gradient through many steps is amplified or damped by the integrator as well as by the physics."
    labels = ("time step h", "change of the energy in 100 steps")

    def measure(self) -> Outcome:
        """Roll out two orthogonal starts, whose squared ends add up to the growth of the energy."""
        figures, series = [], {}
        for name, (step, published, backend) in ENERGIES.items():
            energy = sum(self._ends(name, step, backend))
            figures.append(Figure(f"energy after {STEPS} steps of {step:g}, {name}", published, energy, spread=EXACT))
            series[name] = energy
        for name, (step, published, backend) in PLACES.items():
            place = self._ends(name, step, backend)[0]
            figures.append(Figure(f"squared place, {name}", published, place, spread=EXACT))
        return Outcome(figures, series=series)

    @staticmethod
    def _ends(integrator: str, step: float, backend: str) -> list[float]:
        """Return the squared places at the end of x'' = -x from (1, 0) and from (0, 1)."""
        at = problem(f"mass_spring[stiffness=0.5,dt={step},horizon={STEPS}]", backend=backend, integrator=integrator)
        still = np.zeros((at.program.n_noise, 1))
        return [float(at.value(np.array(start), still)[0]) for start in ([1.0, 0.0], [0.0, 1.0])]

    def draw(self, axes: Axes, series: Mapping[str, Any]) -> None:
        """Draw the energies."""
        axes.bar(list(series), list(series.values()))
        axes.axhline(1.0, color="0.5")
