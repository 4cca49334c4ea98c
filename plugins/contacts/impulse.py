"""Rigid impacts resolved once per step."""

from dataclasses import dataclass
from typing import ClassVar

from bench.contracts import Array, Contact, ImpulseLaw, Ops, State, param


@dataclass(frozen=True)
class Impulse(ImpulseLaw):
    """If the predicted position passes a surface and the velocity is towards it, reverse the normal velocity.

    The velocity changes by -(1 + e) v_n; with ``time_of_impact`` the position is also moved as if the impulse had
    come when the surface was met (Hu et al. 2020, DiffTaichi; Zhong, Han, Brikis 2022). Without it the forward motion
    is right to first order in dt and its derivative has the wrong sign at every dt.
    The step at which an impact falls switches with theta, so rollouts are not continuous in general.
    """

    name = "impulse"
    continuous: ClassVar[bool] = False

    time_of_impact: bool = param(True, "correct the position for the time of impact within the step")

    def impulse(self, ops: Ops, contact: Contact, before: State, free: State, dt: float) -> State:
        """Velocity change, and position change beyond dt times it."""
        xp = ops.xp
        rate = contact.gap_rate(before.q, before.v)
        overlap = -contact.gap(before.q + dt * before.v)
        hit = (overlap > 0) & (rate < 0)
        approach = xp.where(hit, -rate, 0.0 * rate + 1.0)
        strength = (1.0 + contact.restitution) * approach / response(xp, contact, before.q)
        strength = xp.where(hit, strength, 0.0 * strength)
        dv = contact.acceleration(before.q, strength)
        if not self.time_of_impact:
            return State(0.0 * dv, dv)
        early = overlap / approach - dt
        early = xp.where(early < 0, early, 0.0 * early)
        return State(contact.acceleration(before.q, strength * early), dv)


def response(xp: object, contact: Contact, q: Array) -> Array:
    """Gap acceleration of each contact per unit of its own force, diag(J M^-1 J^T), ``(n_contacts, B)`` [1/kg]."""
    gap = contact.gap(q)
    rows = []
    for i in range(gap.shape[0]):
        unit = xp.stack([0.0 * gap[j] + (1.0 if i == j else 0.0) for j in range(gap.shape[0])])  # type: ignore[attr-defined]
        rows.append(contact.gap_rate(q, contact.acceleration(q, unit))[i])
    return xp.stack(rows)  # type: ignore[attr-defined,no-any-return]
