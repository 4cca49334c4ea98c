"""Different contact laws in the forward and backward passes."""

from dataclasses import dataclass
from typing import Any

from bench.plugins.contacts.penalty import Penalty
from bench.plugins.contacts.softplus import Softplus

from bench.model import Array, ForceLaw, param, stopped


@dataclass(frozen=True)
class StraightThrough(ForceLaw):
    """Applies the forces of law ``forward``, with the derivatives of law ``backward`` at the same states.

    The gradient is a surrogate, not the derivative of the program: each step is differentiated as if ``backward`` acted
    in it. With a hard forward law and a softplus backward law, the gradient includes forces between bodies that miss
    each other, while the motion is not smoothed. With ``none``, contact forces are differentiated as constants.
    Source: Paulus et al. 2025; straight-through estimators, Bengio et al. 2013.
    """

    name = "straight_through"
    smoothing = "beta"
    surrogate = True

    forward: str = param("penalty", "law of the motion", choices=("penalty", "softplus"))
    backward: str = param("softplus", "law of the gradient", choices=("softplus", "penalty", "none"))
    stiffness: float = param(1e3, "k, force per penetration, of both laws", "N/m", positive=True)
    damping: float = param(0.0, "c, force per penetration rate, of both laws", "N s/m", low=0.0)
    beta: float = param(
        1e2, "sharpness of a softplus, which smooths the gap over a distance of about 1/beta", "1/m", positive=True
    )

    @property
    def continuous(self) -> bool:
        """True except for a penalty with damping in the forward pass."""
        return self.forward == "softplus" or self.damping == 0.0

    def spring(self) -> tuple[float, float]:
        return self.stiffness, self.damping

    def force(self, xp: Any, gap: Array, gap_rate: Array) -> Array:
        ahead = stopped(self._law(self.forward).force(xp, gap, gap_rate))
        if self.backward == "none":
            return ahead
        behind = self._law(self.backward).force(xp, gap, gap_rate)
        return ahead + (behind - stopped(behind))

    def _law(self, name: str) -> ForceLaw:
        if name == "penalty":
            return Penalty(stiffness=self.stiffness, damping=self.damping)
        return Softplus(stiffness=self.stiffness, damping=self.damping, beta=self.beta)
