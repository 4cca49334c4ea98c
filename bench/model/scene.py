"""Scenes: minimal physical problems, and their possible roles (contact, friction, damping, engine twin, oscillator)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bench.errors import Unsupported, UserError
from bench.model.contact import Contact, ContactLaw
from bench.model.ops import Array, State
from bench.model.parameters import Plugin, param


@dataclass(frozen=True)
class Scene(Plugin):
    """A problem: decision variable theta, noise, cost. It models only what its question needs.

    ``J_sigma(theta) = E_w f(theta, w)`` with ``w ~ N(0, I)``; ``sigma`` always multiplies w.
    """

    kind: ClassVar[str] = "scenes"
    neglected_effects: ClassVar[str] = ""
    """What the scene does not model, in a few words."""
    backends: ClassVar[tuple[str, ...]] = ()
    """Names of the backends that it runs on; empty for all whose array namespace its code is written for."""
    continuous: ClassVar[bool] = True
    """Whether the cost is continuous in theta (given a continuous contact law)."""
    identifies: ClassVar[bool] = False
    """Whether theta are parameters of the scene, to be found from a record that the cost compares it with."""

    sigma: float = param(0.1, "standard deviation of the Gaussian noise in J", positive=True)
    noise: str = param(
        "parameter", "what the noise perturbs: theta, or the actions of each step", choices=("parameter",)
    )

    @abstractmethod
    def theta0(self) -> np.ndarray:
        """Return the decision variable at which gradients are estimated, ``(d,)``."""

    def breakpoints(self) -> tuple[tuple[float, ...], ...]:
        """Return, per coordinate of theta, where the cost jumps or has a kink: panel edges of the quadrature."""
        return ()

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray | None:
        """Return grad J_sigma at :meth:`theta0` of the *program* (the scene under that law and integrator), or None."""
        return None

    def physical_gradient(self) -> np.ndarray | None:
        """Return grad f at :meth:`theta0`, without noise, of the *physics* (rigid contact, dt -> 0), or None."""
        return None

    def physical_cost(self) -> float | None:
        """Return f at :meth:`theta0`, without noise, of the same physics, or None."""
        return None


@dataclass(frozen=True)
class FunctionScene(Scene):
    """A scene that is a plain function of ``x = theta + sigma w``."""

    @abstractmethod
    def cost(self, xp: Any, x: Array) -> Array:
        """Return f at ``x (d, B)``: ``(B,)``."""


@dataclass(frozen=True)
class DisturbedScene(FunctionScene):
    """A role: a plain function with noise of its own, beside the noise on theta.

    ``J_sigma(theta) = E f(theta + sigma u, e)`` over both: d normal numbers u, then ``exogenous`` of the scene's own, e.
    No estimator smoothes over e by shifting it, and no score takes it.
    """

    exogenous: ClassVar[int]
    """How many normal numbers of its own a sample has."""

    @abstractmethod
    def disturbed_cost(self, xp: Any, x: Array, e: Array) -> Array:
        """Return f at ``x (d, B)`` under the scene's own noise ``e (exogenous, B)``: ``(B,)``."""

    def cost(self, xp: Any, x: Array) -> Array:
        """Return f without noise of its own."""
        return self.disturbed_cost(xp, x, xp.zeros((self.exogenous, x.shape[1]), dtype=x.dtype))


@dataclass(frozen=True)
class MechanicalScene(Scene):
    """A scene with dynamics ``q' = v``, ``v' = acceleration(q, v, u) + contact``, ``horizon`` steps of ``dt``.

    Bodies that touch make it a :class:`ContactScene`, Coulomb friction a :class:`FrictionScene`. Mix in
    :class:`EngineTwin` for a physics engine's model of it, :class:`Oscillator` where its motion is linear.
    """

    n_q: ClassVar[int]
    n_v: ClassVar[int | None] = None
    """Length of v if it differs from that of q: n_q = 0 with n_v = 1 makes a first-order scene v' = acceleration(v)."""
    n_u: ClassVar[int] = 0
    n_contacts: ClassVar[int] = 0
    """Contacts that a contact law acts in; more than 0 only in a :class:`ContactScene` or an :class:`EngineScene`."""
    open_loop: ClassVar[bool] = False
    """Whether theta is the sequence of controls itself, step by step."""
    contact_values: ClassVar[Mapping[str, Any]] = {}
    """Values that this scene gives to the parameters of its contact law, whichever it is, unless the user sets them."""

    horizon: int = param(100, "number of time steps", "steps", positive=True)
    dt: float = param(0.01, "length of a time step", "s", positive=True)

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if cls.n_contacts and not issubclass(cls, ContactScene | EngineScene):
            raise TypeError(
                f"{cls.__name__} has n_contacts={cls.n_contacts}: derive it from ContactScene and give its gap, gap_rate "
                "and contact_acceleration (or from EngineScene, where only an engine knows its contacts)"
            )

    @abstractmethod
    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return the state at t = 0 for ``theta (d, B)``."""

    @abstractmethod
    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Return the generalised acceleration without contact, ``(n_v, B)``; ``u`` is ``(n_u, B)``."""

    @abstractmethod
    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the cost of the state after the last step, ``(B,)``."""

    def planned_controls(self, xp: Any, theta: Array) -> Array | None:
        """Return the open-loop part of the control law, ``(horizon, n_u, B)``, or None."""
        if not self.open_loop:
            return None
        return self.held(xp, xp.reshape(theta, (self.controls, self.n_u, theta.shape[1])))

    @property
    def controls(self) -> int:
        """Number of controls in a rollout: one per step unless a :class:`ZeroOrderHoldScene` holds them."""
        return self.horizon

    def held(self, xp: Any, values: Array) -> Array:
        """Return what each control has, ``(controls, ...)``, for each step, ``(horizon, ...)``."""
        return values

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array | None:
        """Return the feedback part of the control law, ``(n_u, B)``, added to the planned one, or None."""
        return None

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array | float:
        """Return the cost of one step, taken at the state before it, ``(B,)``."""
        return 0.0

    def cost_terms(self, xp: Any, q: Array, v: Array, u: Array) -> Mapping[str, Array]:
        """Return parts of the stage cost by name, each ``(B,)``, which ``trace`` shows separately; none by default."""
        return {}

    def carried(self, v: Array) -> Array:
        """Return the velocity that a step carries over from the one before it."""
        # the factor 1 keeps the operations that a compiler sees, and with them the last digit of stored results
        return 1.0 * v


@dataclass(frozen=True)
class DampedScene(MechanicalScene):
    """A role: the velocity is multiplied by a factor each step (numerical damping)."""

    velocity_factor: float = param(1.0, "factor on the velocity each step", low=0.0)

    def carried(self, v: Array) -> Array:
        """Return the factor times v."""
        return self.velocity_factor * v


@dataclass(frozen=True)
class ProcessNoiseScene(MechanicalScene):
    """A role: noise from outside on every control of every step, beside the noise on theta.

    ``u_t = plan + feedback + gust e_t`` with ``horizon * n_u`` normal numbers e, which follow the d numbers on theta, so
    that J averages over both. No estimator smoothes over e by shifting it, and no score takes it. What u does is the
    scene's own: a channel may be a force of the wind, or a share by which a mass or a stiffness is off in that step.
    """

    noise: str = param("parameter", "what sigma perturbs; the gusts come beside it", choices=("parameter",))
    gust: float = param(0.1, "standard deviation of the noise from outside on each control", low=0.0)

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if not cls.n_u:
            raise TypeError(f"{cls.__name__} has gusts on its controls: set n_u")


@dataclass(frozen=True)
class ZeroOrderHoldScene(MechanicalScene):
    """A role: each control of an open loop, and its noise, is held over ``hold`` steps (zero-order hold).

    The step can then be refined with theta, the noise and the duration as they were: ``horizon`` and ``hold`` grow by a
    factor by which ``dt`` falls. Weight a stage cost by ``1 / hold`` to keep the objective as it was too.
    """

    hold: int = param(1, "steps over which each control and its noise are held", "steps", positive=True)

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if not cls.open_loop:
            raise TypeError(f"{cls.__name__} holds its controls: set open_loop, a feedback law acts at every step")

    @property
    def controls(self) -> int:
        """Number of controls; raises :class:`UserError` unless they fill the horizon."""
        if self.horizon % self.hold:
            raise UserError(f"hold={self.hold} does not divide the horizon of {self.horizon} steps")
        return self.horizon // self.hold

    def held(self, xp: Any, values: Array) -> Array:
        """Return each control's values ``hold`` times."""
        if self.hold == 1:
            return values
        rest = values.shape[1:]
        every = xp.broadcast_to(values[:, None, ...], (self.controls, self.hold, *rest))
        return xp.reshape(every, (self.horizon, *rest))


@dataclass(frozen=True)
class ContactScene(MechanicalScene):
    """A role: bodies that touch. Give ``n_contacts``, the gaps between bodies, and how a contact force moves them."""

    restitution: float = param(1.0, "restitution of impulse laws", low=0.0, high=1.0)

    @abstractmethod
    def gap(self, xp: Any, q: Array) -> Array:
        """Return the signed distances between bodies, negative in penetration, ``(n_contacts, B)`` [m]."""

    @abstractmethod
    def gap_rate(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the time derivative of :meth:`gap`, ``(n_contacts, B)`` [m/s]."""

    @abstractmethod
    def contact_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        """Return M^-1 J^T force for normal forces ``(n_contacts, B)`` [N], linear in them: ``(n_v, B)``."""

    def contact(self, xp: Any) -> Contact:
        """Return the contact geometry, as impulse laws take it."""
        return Contact(
            gap=lambda q: self.gap(xp, q),
            gap_rate=lambda q, v: self.gap_rate(xp, q, v),
            acceleration=lambda q, force: self.contact_acceleration(xp, q, force),
            restitution=self.restitution,
        )


@dataclass(frozen=True)
class FrictionScene(ContactScene):
    """A role: contacts with Coulomb friction, regularised as friction * normal force * tanh(slip / slip_speed)."""

    friction: float = param(0.5, "Coulomb coefficient of the contacts under a force law", low=0.0)
    slip_speed: float = param(1e-3, "speed at which friction has grown to tanh(1) of its bound", "m/s", positive=True)

    @abstractmethod
    def slip(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the tangential velocities at the contacts, ``(n_contacts, B)`` [m/s]."""

    @abstractmethod
    def friction_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        """Return M^-1 J_t^T force for tangential forces ``(n_contacts, B)`` [N], linear in them: ``(n_v, B)``."""


class EngineTwin(ABC):
    """A role: the scene as a physics engine's model."""

    twin_difference: ClassVar[float] = 1e-9
    """Relative difference allowed between the costs of the twin and of the scene's own program under ``penalty``."""

    @abstractmethod
    def mjcf(self) -> str:
        """Return the scene's twin for physics engines, as the content of an MJCF ``<mujoco>`` element.

        The twin's joints (slides and hinges) are q in order, its motors take u, and its contact pairs are the contacts.
        The backend sets time step, solver and contact springs; gravity is zero unless an ``<option>`` says otherwise.
        """


@dataclass(frozen=True)
class EngineScene(EngineTwin, MechanicalScene):
    """A role: a scene that exists only as its twin, so that only backends that provide ``physics`` run it."""

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Raise :class:`Unsupported`: only the engine knows the acceleration."""
        raise Unsupported(f"scene {self.name} exists only as an engine's model and has no accelerations of its own")


class Oscillator(ABC):
    """A role: the scene's motion is that of a linear oscillator, so that its stability has a closed form."""

    @abstractmethod
    def oscillator(self) -> tuple[float, float, float]:
        """Return stiffness [1/s^2] and damping [1/s] per unit of mass, and velocity factor, for transition matrices."""
