"""Base of scenes with one contact along a coordinate."""

from dataclasses import dataclass
from typing import Any, ClassVar

from bench.model import Array, ContactScene


@dataclass(frozen=True)
class AxisContactScene(ContactScene):
    """A role: one contact, whose gap is a coordinate of q. The slip of a :class:`FrictionScene` is a velocity too."""

    n_contacts: ClassVar[int] = 1
    gap_axis: ClassVar[int] = 0
    """Index of the coordinate that is the gap."""
    slip_axis: ClassVar[int]
    """Index of the velocity that is the slip."""
    contact_mass: ClassVar[str] = "mass"
    """Name of the parameter that is the mass of these coordinates."""

    def gap(self, xp: Any, q: Array) -> Array:
        """Return the coordinate, ``(1, B)`` [m]."""
        return q[self.gap_axis : self.gap_axis + 1]

    def gap_rate(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the coordinate's velocity, ``(1, B)`` [m/s]."""
        return v[self.gap_axis : self.gap_axis + 1]

    def contact_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        """Return the acceleration of the coordinate by the normal force, ``(n_v, B)``."""
        return self._pushed(xp, self.gap_axis, force)

    def slip(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the tangential velocity, ``(1, B)`` [m/s]."""
        return v[self.slip_axis : self.slip_axis + 1]

    def friction_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        """Return the acceleration by the tangential force, ``(n_v, B)``."""
        return self._pushed(xp, self.slip_axis, force)

    def _pushed(self, xp: Any, axis: int, force: Array) -> Array:
        moved, still = force[0] / getattr(self, self.contact_mass), 0.0 * force[0]
        return xp.stack([moved if i == axis else still for i in range(self.n_q)])
