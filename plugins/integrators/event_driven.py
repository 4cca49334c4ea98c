"""Second-order time steps, split at the time of impact."""

from dataclasses import dataclass
from typing import Any

from bench.model import Array, Contact, Dynamics, State

from .stormer_verlet import StormerVerlet, flight


@dataclass(frozen=True)
class EventDriven(StormerVerlet):
    """Stormer-Verlet. Under an impulse law, a step is split at its first impact, where the law is applied.

    The time of impact is a root of gap + rate t + acceleration t^2 / 2, differentiated in closed form, so that speed
    and time of the impact depend on theta as in the physics. Gradients of rigid bounces are correct to discretisation
    error, and exact under constant acceleration, which no correction of a whole step achieves. The law reverses the
    velocity at the impact, and the remainder of the step starts from the new velocity.

    Each contact has at most one impact per step: a body that returns earlier (coming to rest) sinks slowly, by less
    than dt^2 g / 2 per step. The gap's acceleration neglects the gap's curvature in q. Further contacts in the
    remainder of a step, and steps without an impact, are handled by the law as in other integrators. Intended for rigid
    laws; without an impulse law it equals Stormer-Verlet.
    """

    name = "event_driven"
    takes_impulses = True

    def step(self, dynamics: Dynamics, state: State, u: Array, dt: float) -> State:
        q, v = state.q, dynamics.carried(state.v)
        contact = dynamics.contact
        if contact is None:
            return flight(dynamics, State(q, v), u, dt)
        a = dynamics.acceleration(q, v, u)
        time = _first_impact(dynamics.ops.xp, contact, State(q, v), a, dt)
        met = State(q + time * (v + 0.5 * time * a), v + time * a)
        return dynamics.with_impulse(met, flight(dynamics, met, u, dt - time), dt - time)


def _first_impact(xp: Any, contact: Contact, state: State, a: Array, dt: Any) -> Array:
    """Return the time from the start of the step to its first impact, ``(1, B)`` [s]; 0 without one."""
    gap, rate, bend = contact.gap(state.q), contact.gap_rate(*state), contact.gap_rate(state.q, a)
    square = rate * rate - 2.0 * bend * gap
    # the unused branch of xp.where is differentiated too: sqrt(<= 0) or a division by 0 would make that column's
    # gradient NaN, so the root's argument and both divisors are 1 where they are not used
    crossing = square > 0
    speed = xp.sqrt(xp.where(crossing, square, 0.0 * square + 1.0))
    approaching, pulled = rate < 0, bend < 0
    soon = 2.0 * gap / xp.where(approaching, speed - rate, 0.0 * rate + 1.0)
    later = (rate + speed) / xp.where(pulled, -bend, 0.0 * bend + 1.0)
    time = xp.where(approaching, soon, later)
    # fraction of a step by which an impact may lie in the past, since rounding may delay its detection
    hit = crossing & (approaching | pulled) & (time > -1e-3 * dt) & (time < dt)
    first = xp.min(xp.where(hit, time, 0.0 * time + dt), axis=0, keepdims=True)
    return xp.where(xp.any(hit, axis=0, keepdims=True), first, 0.0 * first)
