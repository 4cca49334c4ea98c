"""The logistic map: a record of chaos, whose rate has more local minima of the fit the longer the windows are."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.model import Identified, MechanicalScene, State, param


@dataclass(frozen=True)
class LogisticMap(Identified, MechanicalScene):
    """x' = rate x (1 - x) - x, a first-order scene whose state is the velocity; theta = x_0, parameter noise; f = x_N.

    A step of 1 s by explicit Euler is the logistic map x -> rate x (1 - x), to the last digit: the step starts at
    ``(1 - dt) x``, which is 0. At 3.78 the map is chaotic, and a difference grows by about e^0.4 in each step.
    """

    name = "logistic_map"
    neglected_effects = "random changes of the state"
    continuous: ClassVar[bool] = True
    n_q: ClassVar[int] = 0
    n_v: ClassVar[int | None] = 1
    unknowns: ClassVar[tuple[str, ...]] = ("rate",)
    measured: ClassVar[tuple[int, ...] | None] = (0,)

    sigma: float = param(0.01, "standard deviation of the noise on x_0", positive=True)
    horizon: int = param(20, "number of time steps", "steps", positive=True)
    dt: float = param(1.0, "length of a time step", "s", positive=True, high=1.0)
    rate: float = param(3.78, "factor of x (1 - x)", "1/s", low=0.0, high=4.0)
    start: float = param(0.5, "x_0 at theta", low=0.0, high=1.0)

    def theta0(self):
        """Return (x_0,)."""
        return np.array([self.start])

    def initial_state(self, xp, theta):
        """Return no position and x_0 as velocity."""
        return State(theta[:0], theta)

    def carried(self, v):
        """Return (1 - dt) x: the decay -x over a step of explicit Euler."""
        return (1.0 - self.dt) * v

    def acceleration(self, xp, q, v, u):
        """Return rate x (1 - x)."""
        return self.rate * v * (1.0 - v)

    def terminal_cost(self, xp, q, v):
        """Return x_N."""
        return v[0]
