"""Explicit contact: a spring and damper while bodies overlap."""

from dataclasses import dataclass
from typing import Any

from bench.model import Array, ForceLaw, param


@dataclass(frozen=True)
class Penalty(ForceLaw):
    """lambda = k d + c d' while the penetration d = max(0, -gap) is positive.

    ``damping_mode`` selects where the damper acts, since sources and their gradients differ:
    ``clipped`` max(0, k d + c d'), never adhesive; ``approach`` k d + c max(0, d'); ``linear`` k d + c d', which
    pulls at the end of a contact.
    """

    name = "penalty"

    stiffness: float = param(1e3, "k, force per penetration", "N/m", positive=True)
    damping: float = param(0.0, "c, force per penetration rate", "N s/m", low=0.0)
    damping_mode: str = param("clipped", "when the damper acts", choices=("clipped", "approach", "linear"))

    @property
    def continuous(self) -> bool:
        """True only without damping: a damper acts immediately at first touch, so the force jumps."""
        return self.damping == 0.0

    def spring(self) -> tuple[float, float]:
        return self.stiffness, self.damping

    def force(self, xp: Any, gap: Array, gap_rate: Array) -> Array:
        force = -self.stiffness * gap
        # without damping the spring acts alone; a compiled program and theta have the damping as an array
        if not isinstance(self.damping, float) or self.damping:
            damper = -self.damping * gap_rate
            if self.damping_mode == "approach":
                damper = xp.where(damper > 0, damper, 0.0)
            force = damper + force
            if self.damping_mode == "clipped":
                force = xp.where(force > 0, force, 0.0)
        return xp.where(gap < 0, force, 0.0)
