"""The contract of a contact law, which computes forces or impulses between bodies in contact."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from bench.host.parameters import Plugin
from bench.model.ops import Array, Ops, State


@dataclass(frozen=True)
class ContactLaw(Plugin):
    """Computes the forces or impulses between bodies in contact."""

    kind: ClassVar[str] = "contacts"
    smoothing: ClassVar[str] = ""
    """Name of the parameter that smooths the law (``beta``, ``kappa``), or an empty string."""
    surrogate: ClassVar[bool] = False
    """Whether automatic differentiation of a step intentionally gives a gradient other than the step's derivative."""
    needs_root: ClassVar[bool] = False
    """Whether the law solves an equation each step, so that only backends with ``root`` can run it."""
    ignores: ClassVar[tuple[str, ...]] = ()
    """Parameters of scenes that have no effect under the law, such as ``restitution``."""

    @property
    def continuous(self) -> bool:
        """Whether the state after a step is continuous in the state before it."""
        return True


@dataclass(frozen=True)
class ForceLaw(ContactLaw):
    """A law whose force is a function of gap and gap rate and is part of the acceleration."""

    ignores: ClassVar[tuple[str, ...]] = ("restitution",)

    @abstractmethod
    def force(self, xp: Any, gap: Array, gap_rate: Array) -> Array:
        """Return the normal force ``(n_contacts, B)`` [N], positive if the bodies repel each other."""

    def spring(self) -> tuple[float, float] | None:
        """Return stiffness [N/m] and damping [N s/m] of the law's linear spring limit in deep contact, or None."""
        return None


class Contact(NamedTuple):
    """The scene's contact geometry for impulse laws. Its fields are functions, see :class:`ContactScene`."""

    gap: Callable[[Array], Array]
    gap_rate: Callable[[Array, Array], Array]
    acceleration: Callable[[Array, Array], Array]
    restitution: Any

    def response(self, xp: Any, q: Array) -> Array:
        """Return each contact's gap acceleration per unit of its force, diag(J M^-1 J^T), ``(n_contacts, B)`` [1/kg]."""
        gap = self.gap(q)
        rows = []
        for i in range(gap.shape[0]):
            # 0 times the gap has the batch shape, type and library of the backend's arrays
            unit = xp.stack([0.0 * gap[j] + float(i == j) for j in range(gap.shape[0])])
            rows.append(self.gap_rate(q, self.acceleration(q, unit))[i])
        return xp.stack(rows)


@dataclass(frozen=True)
class ImpulseLaw(ContactLaw):
    """A law that changes velocities and positions within a step instead of adding a force. It has no friction."""

    ignores: ClassVar[tuple[str, ...]] = ("friction", "slip_speed")

    @abstractmethod
    def impulse(self, ops: Ops, contact: Contact, before: State, free: State, dt: Any) -> State:
        """Return the changes of velocity and position over one step, as a :class:`State`.

        The position change is in addition to ``dt`` times the velocity change. ``before`` is the state at the start of
        the step, ``free`` the state after a step without contact.
        """

    def finds_time_of_impact(self) -> bool:
        """Return whether, after free flight into one surface, the impulse acts exactly at the time of impact."""
        return False
