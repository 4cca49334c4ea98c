"""A unit step: the smallest cost with a jump."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, Events, EventScene, FunctionScene, Plugin, half_spaces, param


@dataclass(frozen=True)
class Heaviside(EventScene, FunctionScene):
    """f = 1 where x >= 0, else 0, with x = theta + sigma w (d = 1).

    Its derivative is 0 wherever it exists, while grad J = phi(theta / sigma) / sigma. Source: Suh et al. 2022.
    """

    name = "heaviside"
    theta_names = ("theta",)
    neglected_effects = "dynamics; represents a contact that occurs or not"
    continuous = False

    theta: float = param(0.0, "where the gradient is estimated; the jump is at 0")

    def cost(self, xp: Any, x: Array) -> Array:
        """Return the step, with derivative 0."""
        zero = 0.0 * x[0]
        return xp.where(x[0] >= 0, zero + 1.0, zero)

    def events(self, theta: np.ndarray, w: np.ndarray) -> Events:
        """Return the event x >= 0."""
        return half_spaces(np.ones((1, 1)), np.zeros(1), self.sigma, theta, w)

    def breakpoints(self) -> tuple[tuple[float, ...], ...]:
        return ((0.0,),)

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray:
        """Return phi(theta / sigma) / sigma."""
        z = self.theta / self.sigma
        return np.array([math.exp(-0.5 * z * z) / (math.sqrt(2 * math.pi) * self.sigma)])
