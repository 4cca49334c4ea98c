"""Rigid impacts resolved once per step."""

from dataclasses import dataclass

from bench.model import Contact, ImpulseLaw, Ops, State, param


@dataclass(frozen=True)
class Impulse(ImpulseLaw):
    """Reverses the normal velocity if the predicted position is behind a surface and the velocity is towards it.

    The velocity changes by -(1 + e) v_n. With ``time_of_impact``, the position is also changed as if the impulse had
    acted when the body reached the surface (Hu et al. 2020, DiffTaichi; Zhong, Han, Brikis 2022). Without it, the
    motion is correct to first order in dt, but its derivative has the wrong sign at every dt. The step in which an
    impact occurs changes with theta, so rollouts are not continuous in general.
    """

    name = "impulse"

    time_of_impact: bool = param(True, "correct the position for the time of impact within the step")

    @property
    def continuous(self) -> bool:
        """False: the step in which an impact occurs changes with theta."""
        return False

    def finds_time_of_impact(self) -> bool:
        return self.time_of_impact

    def impulse(self, ops: Ops, contact: Contact, before: State, free: State, dt: float) -> State:
        xp = ops.xp
        rate = contact.gap_rate(before.q, before.v)
        overlap = -contact.gap(before.q + dt * before.v)
        hit = (overlap > 0) & (rate < 0)
        # without a hit, the value and derivative of the division by approach must be finite
        approach = xp.where(hit, -rate, 0.0 * rate + 1.0)
        strength = (1.0 + contact.restitution) * approach / contact.response(xp, before.q)
        strength = xp.where(hit, strength, 0.0 * strength)
        dv = contact.acceleration(before.q, strength)
        if not self.time_of_impact:
            return State(0.0 * dv, dv)
        early = overlap / approach - dt
        # includes a gap of exactly 0 before the step, whose time of impact also changes with theta
        # fraction of a step within which an impact counts as at the start of the step: a little above rounding errors
        early = xp.where(early <= 1e-9 * dt, early, 0.0 * early)
        return State(contact.acceleration(before.q, strength * early), dv)
