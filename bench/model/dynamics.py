"""The dynamics of a scene under a contact law, as integrators use them."""

from __future__ import annotations

from typing import Any

from bench.model.contact import Contact, ContactLaw, ForceLaw, ImpulseLaw
from bench.model.ops import Array, Ops, State
from bench.model.scene import ContactScene, FrictionScene, MechanicalScene


class Dynamics:
    """Accelerations (with contact forces) and impulses of a scene under a contact law; None: without contact."""

    def __init__(self, ops: Ops, scene: MechanicalScene, law: ContactLaw | None) -> None:
        self.ops = ops
        self._scene = scene
        touching = isinstance(scene, ContactScene)
        self._force_law = law if isinstance(law, ForceLaw) and touching else None
        self._impulse_law = law if isinstance(law, ImpulseLaw) and touching else None

    def acceleration(self, q: Array, v: Array, u: Array) -> Array:
        """Return the acceleration v', including the forces of a :class:`ForceLaw`, ``(n_v, B)``."""
        xp, scene = self.ops.xp, self._scene
        smooth = scene.acceleration(xp, q, v, u)
        if self._force_law is None or not isinstance(scene, ContactScene):
            return smooth
        force = self._force_law.force(xp, scene.gap(xp, q), scene.gap_rate(xp, q, v))
        pushed = smooth + scene.contact_acceleration(xp, q, force)
        if not isinstance(scene, FrictionScene):
            return pushed
        bound = -scene.friction * force * xp.tanh(scene.slip(xp, q, v) / scene.slip_speed)
        return pushed + scene.friction_acceleration(xp, q, bound)

    @property
    def contact(self) -> Contact | None:
        """The contact geometry for integrators that resolve impacts themselves; None without an impulse law."""
        if self._impulse_law is None or not isinstance(self._scene, ContactScene):
            return None
        return self._scene.contact(self.ops.xp)

    def carried(self, v: Array) -> Array:
        """Return the velocity at which a step starts, after the scene's numerical damping, ``(n_v, B)``."""
        return self._scene.carried(v)

    def with_impulse(self, before: State, free: State, dt: Any) -> State:
        """Return ``free``, the state after a step without contact, corrected by the impulse law if there is one."""
        contact, law = self.contact, self._impulse_law
        if contact is None or law is None:
            return free
        change = law.impulse(self.ops, contact, before, free, dt)
        return State(free.q + dt * change.v + change.q, free.v + change.v)
