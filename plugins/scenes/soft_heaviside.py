"""A step of finite width: continuous, and as hard to sample as the jump."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, FunctionScene, Plugin, param


@dataclass(frozen=True)
class SoftHeaviside(FunctionScene):
    """f = clip(2 x / nu, -1, 1), with x = theta + sigma w (d = 1).

    With p the probability that |x| < nu / 2: grad J = 2 p / nu, and a sample's derivative has variance (2 / nu)^2 p (1
    - p), so that first-order gradients are unbiased and, at small nu, useless. Source: Suh et al. 2022.
    """

    name = "soft_heaviside"
    theta_names = ("theta",)
    neglected_effects = "dynamics; represents a stiff contact that occurs or not"
    continuous = True

    theta: float = param(0.0, "where the gradient is estimated; the ramp is around 0")
    nu: float = param(0.1, "width of the ramp", positive=True)

    def cost(self, xp: Any, x: Array) -> Array:
        """Return the ramp from -1 to 1."""
        z = 2.0 * x[0] / self.nu
        flat = 0.0 * z
        return xp.where(z > 1, flat + 1.0, xp.where(z < -1, flat - 1.0, z))

    def breakpoints(self) -> tuple[tuple[float, ...], ...]:
        return ((-self.nu / 2, self.nu / 2),)

    def probability(self) -> float:
        """Return p, the probability that a sample lies on the ramp."""
        scale = math.sqrt(2) * self.sigma
        upper, lower = (self.nu / 2 - self.theta) / scale, (-self.nu / 2 - self.theta) / scale
        return 0.5 * (math.erf(upper) - math.erf(lower))

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray:
        """Return 2 p / nu."""
        return np.array([2 * self.probability() / self.nu])
