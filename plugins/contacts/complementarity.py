"""Implicit contact: force and motion agree at the end of a step. Solved on the central path of the complementarity condition."""

from dataclasses import dataclass
from typing import Any

from bench.model import Array, Contact, ImpulseLaw, Ops, State, param


@dataclass(frozen=True)
class Complementarity(ImpulseLaw):
    """Solves lambda y = kappa, lambda >= 0, y >= 0 at the end of the step, with y = gap + lambda / stiffness.

    kappa -> 0 is hard contact, and infinite stiffness rigid contact: impacts are inelastic, and the scene's restitution
    is ignored, as is its friction. A finite stiffness is a penalty spring evaluated at the end of the step instead of its start.
    Solved through the Fischer-Burmeister function p + y - sqrt(p^2 + y^2 + 2 c kappa), whose root lies on the
    central path, with p = c lambda the gap that the force opens in a step (c = dt^2 J M^-1 J^T).
    """

    name = "complementarity"
    smoothing = "kappa"
    needs_root = True
    ignores = (*ImpulseLaw.ignores, "restitution")

    kappa: float = param(1e-4, "central-path parameter, force times gap", "N m", positive=True)
    stiffness: float = param(float("inf"), "force per remaining penetration; inf: rigid", "N/m", positive=True)

    @property
    def continuous(self) -> bool:
        """True: on the central path, the force is smooth in the state."""
        return True

    def impulse(self, ops: Ops, contact: Contact, before: State, free: State, dt: float) -> State:
        xp = ops.xp
        opened = dt * dt * contact.response(xp, before.q)

        def effect(p: Array, system: Any) -> Array:
            q, dt, opened = system
            return dt * contact.acceleration(q, p / opened)

        def residual(p: Array, args: Any) -> Array:
            system, q_free, kappa, compliance = args
            _, dt, opened = system
            y = contact.gap(q_free + dt * effect(p, system)) + compliance * p / opened
            return p + y - xp.sqrt(p * p + y * y + 2.0 * opened * kappa)

        system = (before.q, dt, opened)
        compliance = 1.0 / self.stiffness
        # exact for one contact with a linear gap, so that Newton's method starts close to the root
        guess = opened * _central_path_force(xp, contact.gap(free.q), opened + compliance, self.kappa)
        p = ops.root(residual, guess, (system, free.q, self.kappa, compliance))
        dv = effect(p, system)
        return State(0.0 * dv, dv)


def _central_path_force(xp: Any, a: Array, c: Array, kappa: Any) -> Array:
    """Return lambda >= 0 with (a + c lambda) lambda = kappa, the force of one contact whose gap is linear in position."""
    root = xp.sqrt(a * a + 4.0 * c * kappa)
    # two forms of the same root, each without cancellation for its sign of a
    separated = 2.0 * kappa / (xp.abs(a) + root)
    pressed = (xp.abs(a) + root) / (2.0 * c)
    return xp.where(a > 0, separated, pressed)
