"""Rigid contact in the forward pass, with the derivative of a softer one in the backward pass."""

from dataclasses import dataclass

import numpy as np
from bench.plugins.contacts.complementarity import Complementarity

from bench.model import Contact, Ops, State, param, stopped


@dataclass(frozen=True)
class SurrogateBackward(Complementarity):
    """Applies the impulses of ``complementarity`` at ``kappa``, but the derivatives at ``soft_kappa`` in the same states.

    Costs equal the costs of ``complementarity`` at kappa. The gradient is a surrogate, not the derivative of the
    program: each step is differentiated as if bodies pushed each other from a distance, so it is not 0 for bodies that
    narrowly miss. Dojo differentiates a relaxed problem on the central path too (Howell et al. 2022). Estimators that
    are unbiased for any gradient, such as ``control_variate``, stay unbiased with it. For ``penalty`` and ``softplus``
    see ``straight_through``.
    """

    name = "surrogate_backward"
    surrogate = True

    kappa: float = param(1e-6, "central-path parameter of the motion, force times gap", "N m", positive=True)
    soft_kappa: float = param(1e-2, "central-path parameter of the gradient, force times gap", "N m", positive=True)

    def impulse(self, ops: Ops, contact: Contact, before: State, free: State, dt: float) -> State:
        hard = super().impulse(ops, contact, before, free, dt)
        if isinstance(hard.v, np.ndarray):  # without derivatives
            return hard
        soft = Complementarity(kappa=self.soft_kappa, stiffness=self.stiffness).impulse(ops, contact, before, free, dt)
        q, v = (stopped(h) + (s - stopped(s)) for h, s in zip(hard, soft, strict=True))
        return State(q, v)
