"""Rigid impacts resolved once per step."""

from dataclasses import dataclass

from bench.model import Contact, ImpulseLaw, Ops, State, param

TIE = 1e-9
"""Share of a step within which the surface counts as met at its start: beyond rounding, below anything that matters."""


@dataclass(frozen=True)
class Impulse(ImpulseLaw):
    """If the predicted position passes a surface and the velocity is towards it, reverse the normal velocity.

    The velocity changes by -(1 + e) v_n; with ``time_of_impact`` the position is also moved as if the impulse had
    come when the surface was met (Hu et al. 2020, DiffTaichi; Zhong, Han, Brikis 2022). Without it the forward motion
    is right to first order in dt and its derivative has the wrong sign at every dt.
    The step at which an impact falls switches with theta, so rollouts are not continuous in general.
    """

    name = "impulse"

    time_of_impact: bool = param(True, "correct the position for the time of impact within the step")

    @property
    def continuous(self) -> bool:
        """False: the step at which an impact falls switches with theta."""
        return False

    def finds_time_of_impact(self) -> bool:
        """Return whether ``time_of_impact`` is set."""
        return self.time_of_impact

    def impulse(self, ops: Ops, contact: Contact, before: State, free: State, dt: float) -> State:
        """Return the velocity change, and the position change beyond dt times the velocity change."""
        xp = ops.xp
        rate = contact.gap_rate(before.q, before.v)
        overlap = -contact.gap(before.q + dt * before.v)
        hit = (overlap > 0) & (rate < 0)
        # where there is no hit the division by approach must stay finite, in value and derivative
        approach = xp.where(hit, -rate, 0.0 * rate + 1.0)
        strength = (1.0 + contact.restitution) * approach / contact.response(xp, before.q)
        strength = xp.where(hit, strength, 0.0 * strength)
        dv = contact.acceleration(before.q, strength)
        if not self.time_of_impact:
            return State(0.0 * dv, dv)
        early = overlap / approach - dt
        # a gap that is exactly 0 before the step is early too: its time of impact moves with theta like any other
        early = xp.where(early <= TIE * dt, early, 0.0 * early)
        return State(contact.acceleration(before.q, strength * early), dv)
