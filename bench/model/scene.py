"""The contract of a scene, a minimal physical problem, and its roles (mixins): contact, friction, engine twin, ..."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from bench.errors import Unsupported, UserError
from bench.host.parameters import Plugin, param, traced
from bench.model.contact import Contact, ContactLaw
from bench.model.ops import Array, State


@dataclass(frozen=True)
class Scene(Plugin):
    """A problem with decision variable theta, noise and cost. It models only the effects that it studies.

    ``J_sigma(theta) = E_w f(theta, w)`` with ``w ~ N(0, I)``; ``sigma`` always multiplies w.
    """

    kind: ClassVar[str] = "scenes"
    neglected_effects: ClassVar[str] = ""
    """The effects that the scene does not model, in a few words."""
    backends: ClassVar[tuple[str, ...]] = ()
    """Names of the backends that can run the scene; empty: all backends with an array namespace."""
    continuous: ClassVar[bool] = True
    """Whether the cost is continuous in theta, provided that the contact law is continuous."""
    identifies: ClassVar[bool] = False
    """Whether theta consists of scene parameters to be identified, and the cost compares the motion with a record."""
    exogenous: ClassVar[int] = 0
    """Number of the scene's own normal numbers per rollout, the last rows of w. A property where parameters decide it."""
    theta_names: ClassVar[tuple[str, ...]] = ()
    """Names of the parameters that are theta, in place of :meth:`theta0`; in an open-loop scene, those of every control."""

    sigma: float = param(0.1, "standard deviation of the Gaussian noise in J", positive=True)
    noise: str = param("parameter", "whether noise is on theta or on the actions of each step", choices=("parameter",))

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if "theta_names" in vars(cls) and "theta0" not in vars(cls):
            cls.theta0 = _named_theta  # type: ignore[assignment, method-assign]

    @abstractmethod
    def theta0(self) -> np.ndarray:
        """Return the decision variable at which gradients are estimated, ``(d,)``."""

    def without_effect(self, contact: ContactLaw | None) -> tuple[str, ...]:
        """Return the parameters of the scene that change no cost and no gradient under the law: those that it ignores."""
        return () if contact is None else tuple(name for name in contact.ignores if name in traced(self))

    def breakpoints(self) -> tuple[tuple[float, ...], ...]:
        """Return, per coordinate of theta, the positions of the cost's jumps and kinks, which split quadrature panels."""
        return ()

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray | None:
        """Return grad J_sigma of the *program* (scene, law and integrator) at :meth:`theta0`, ``(d,)``, or None."""
        return None

    def physical_gradient(self) -> np.ndarray | None:
        """Return grad f of the *physics* (rigid contact, dt -> 0) at :meth:`theta0`, without noise, ``(d,)``, or None."""
        return None

    def physical_cost(self) -> float | None:
        """Return f of the physics (rigid contact, dt -> 0) at :meth:`theta0`, without noise, or None."""
        return None


def _named_theta(scene: Scene) -> np.ndarray:
    """Return the values of the scene's :attr:`~Scene.theta_names`, once per control of an open loop, ``(d,)``."""
    values = np.array([getattr(scene, name) for name in scene.theta_names])
    return np.tile(values, scene.controls) if isinstance(scene, MechanicalScene) and scene.open_loop else values


@dataclass(frozen=True)
class FunctionScene(Scene):
    """A scene whose cost is a plain function of ``x = theta + sigma u``, for d normal numbers u, and of its own noise e.

    ``J_sigma(theta) = E f(theta + sigma u, e)``, where e are ``exogenous`` normal numbers. Smoothing estimators do not
    shift e, and the score does not depend on it.
    """

    @abstractmethod
    def cost(self, xp: Any, x: Array, *args: Any, **kwargs: Any) -> Array:
        """Return the cost f at ``x (d, B)``: ``(B,)``. With ``exogenous``, its arguments are xp, x and ``e (exogenous, B)``."""


@dataclass(frozen=True)
class MechanicalScene(Scene):
    """A scene with dynamics ``q' = v``, ``v' = acceleration(q, v, u) + contact``, over ``horizon`` steps of ``dt``.

    Derive from :class:`ContactScene` for bodies in contact, from :class:`FrictionScene` for Coulomb friction, from
    :class:`EngineTwin` for a physics engine's model of the scene, and from :class:`Oscillator` for linear motion.
    """

    n_q: ClassVar[int]
    n_u: ClassVar[int] = 0
    n_contacts: ClassVar[int] = 0
    """Number of contacts; more than 0 only in a :class:`ContactScene` or an :class:`EngineScene`."""
    open_loop: ClassVar[bool] = False
    """Whether theta is the sequence of controls, step by step."""
    contact_values: ClassVar[Mapping[str, Any]] = {}
    """Default values for parameters of the scene's contact laws; the user's values have priority."""

    horizon: int = param(100, "number of time steps", "steps", positive=True)
    dt: float = param(0.01, "length of a time step", "s", positive=True)

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if cls.n_contacts and not issubclass(cls, ContactScene | EngineScene):
            raise TypeError(
                f"{cls.__name__} has n_contacts={cls.n_contacts}: derive it from ContactScene and define gap, gap_rate "
                "and contact_acceleration, or from EngineScene if only an engine computes its contacts"
            )

    @property
    def n_v(self) -> int:
        """Length of v: n_q by default. A scene with n_q = 0 and n_v = 1 is first-order: v' = acceleration(v)."""
        return self.n_q

    @abstractmethod
    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return the state at t = 0 for ``theta (d, B)``."""

    def split(self, x: Array) -> State:
        """Return the positions and velocities of states ``x (n, ...)``."""
        return State(x[: self.n_q], x[self.n_q :])

    @staticmethod
    def at_rest(xp: Any, theta: Array, *q: Any) -> State:
        """Return the state with the positions ``q``, one number each, and without velocity, for ``theta (d, B)``."""
        zero = 0.0 * theta[0]
        return State(xp.stack([zero + x for x in q]), xp.stack([zero] * len(q)))

    def starting_state(self, xp: Any, theta: Array, e: Array | None) -> State:
        """Return the state at t = 0 for ``theta (d, B)`` and the scene's own noise ``e (exogenous, B)``, None without it."""
        return self.initial_state(xp, theta)

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

    def in_first_step(self, xp: Any, u: Array) -> Array:
        """Return the controls ``u (n_u, B)`` in the first step and 0 afterwards, ``(horizon, n_u, B)``."""
        return xp.concat([u[None], xp.zeros((self.horizon - 1, *u.shape), dtype=u.dtype)], axis=0)

    @property
    def controls(self) -> int:
        """Number of controls in a rollout: one per step, except in a :class:`ZeroOrderHoldScene`."""
        return self.horizon

    @property
    def substeps(self) -> int:
        """Steps of the integrator per time step, under one control: 1, except in a scene with this parameter."""
        return 1

    def held(self, xp: Any, values: Array) -> Array:
        """Return values per control, ``(controls, ...)``, repeated for each step, ``(horizon, ...)``."""
        return values

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array | None:
        """Return the feedback part of the control law, ``(n_u, B)``, or None. It is added to the open-loop part."""
        return None

    def has_ended(self, xp: Any, q: Array, v: Array) -> Array | None:
        """Return whether rollouts have ended in these states, ``(B,)``; None if they never end early."""
        return None

    def pullback(
        self, theta: np.ndarray, states: np.ndarray, weights: np.ndarray, by_theta: bool = True
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the derivatives of sum(weights * feedback) by theta ``(d, K)`` and by the states ``(n, T, B)``.

        Theta is ``(d, K)``, K is B or 1, states are ``(n, T, B)`` and weights ``(n_u, T, B)``. The first derivative is 0
        without ``by_theta``. None, the default: estimators take central differences of the feedback, 2 d evaluations.
        """
        return None

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array | float:
        """Return the cost of one step from the state before the step, ``(B,)``."""
        return 0.0

    def cost_terms(self, xp: Any, q: Array, v: Array, u: Array) -> Mapping[str, Array]:
        """Return parts of the stage cost by name, each ``(B,)``, for separate display by ``trace``; none by default."""
        return {}

    def carried(self, v: Array) -> Array:
        """Return the velocity at which a step starts, ``(n_v, B)``, after any numerical damping."""
        # the factor 1 preserves the compiled operations, and therefore the last digit of stored results
        return 1.0 * v


@dataclass(frozen=True)
class OpenLoopScene(MechanicalScene):
    """A role: theta is the sequence of controls, step by step, and noise is on each of them."""

    open_loop: ClassVar[bool] = True

    noise: str = param("action", "noise is on the actions", choices=("action",))


@dataclass(frozen=True)
class DampedScene(MechanicalScene):
    """A role: the velocity is multiplied by a factor each step (numerical damping)."""

    velocity_factor: float = param(1.0, "factor on the velocity each step", low=0.0)

    def carried(self, v: Array) -> Array:
        """Return the velocity factor times v."""
        return self.velocity_factor * v


@dataclass(frozen=True)
class ZeroOrderHoldScene(MechanicalScene):
    """A role: each open-loop control, with its noise, is held constant over ``hold`` steps (zero-order hold).

    The time step can then be refined at constant theta, noise and duration: multiply ``horizon`` and ``hold`` and
    divide ``dt`` by the same factor. If the stage cost is divided by ``hold``, the objective is constant too.
    """

    hold: int = param(1, "steps over which each control and its noise are held", "steps", positive=True)

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if not cls.open_loop:
            raise TypeError(
                f"{cls.__name__} holds its controls: set open_loop, since a feedback law acts at every step"
            )

    @property
    def controls(self) -> int:
        """Number of controls; raises :class:`UserError` if ``hold`` does not divide the horizon."""
        if self.horizon % self.hold:
            raise UserError(f"hold={self.hold} does not divide the horizon of {self.horizon} steps")
        return self.horizon // self.hold

    def held(self, xp: Any, values: Array) -> Array:
        """Return values per control, ``(controls, ...)``, each repeated ``hold`` times, ``(horizon, ...)``."""
        if self.hold == 1:
            return values
        rest = values.shape[1:]
        every = xp.broadcast_to(values[:, None, ...], (self.controls, self.hold, *rest))
        return xp.reshape(every, (self.horizon, *rest))


@dataclass(frozen=True)
class ContactScene(MechanicalScene):
    """A role: bodies in contact. Set ``n_contacts`` and define the gaps and the accelerations by contact forces."""

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
        """Return the contact geometry for impulse laws."""
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
    slip_speed: float = param(1e-3, "slip speed at which friction reaches tanh(1) of its limit", "m/s", positive=True)

    @abstractmethod
    def slip(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the tangential velocities at the contacts, ``(n_contacts, B)`` [m/s]."""

    @abstractmethod
    def friction_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        """Return M^-1 J_t^T force for tangential forces ``(n_contacts, B)`` [N], linear in them: ``(n_v, B)``."""


class EngineTwin(ABC):
    """A role: the scene also has a physics engine's model, its twin."""

    twin_difference: ClassVar[float] = 1e-9
    """Maximum relative difference between the costs of the twin and of the scene's program with ``penalty``."""

    @abstractmethod
    def mjcf(self) -> str:
        """Return the scene's twin for physics engines, as the content of an MJCF ``<mujoco>`` element.

        The twin's joints (slides and hinges) are q in order, its motors receive u, and its contact pairs are the
        scene's contacts. The backend sets time step, solver and contact springs. Gravity is 0 unless an ``<option>``
        sets it.
        """

    def model_file(self) -> Path | None:
        """Return the MJCF file that is the scene's model, to be used as it is written; None: the twin of :meth:`mjcf`.

        A scene with such a file also defines ``files()``, the paths of all files that decide its motion and cost.
        """
        return None

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if cls.model_file is not EngineTwin.model_file and not hasattr(cls, "files"):
            raise TypeError(
                f"{cls.__name__} has a model_file, so it needs files(): all files that decide its motion and cost"
            )


@dataclass(frozen=True)
class EngineScene(EngineTwin, MechanicalScene):
    """A role: the scene exists only as an engine's model, so that only backends with ``physics`` can run it."""

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Raise :class:`Unsupported`: only the engine computes the acceleration."""
        raise Unsupported(
            f"scene {self.name} exists only as an engine's model and has no acceleration outside the engine"
        )


class Oscillator(ABC):
    """A role: the scene is a linear oscillator, whose stability has a closed form."""

    @abstractmethod
    def oscillator(self) -> tuple[float, float, float]:
        """Return stiffness [1/s^2] and damping [1/s] per unit of mass, and the velocity factor per step.

        They are the arguments of :meth:`Integrator.transition`.
        """


class Events(NamedTuple):
    """K events of B samples. Event k happens where ``directions[k] . w < limits[k]``.

    The limit of a sample may depend on all of its noise except the number ``directions[k] . w``. Given the other noise,
    event k thus has the probability Phi(limit), with the derivative phi(limit) slope.
    """

    directions: np.ndarray
    """Unit vectors in the space of the noise, ``(K, n_w)``."""
    limits: np.ndarray
    """Limits, in standard deviations of the noise, ``(K, B)``."""
    slopes: np.ndarray
    """Derivatives of the limits by theta, at constant noise and with the other events as they are, ``(K, d, B)``."""


class EventScene(ABC):
    """A role: the scene declares its events, and its cost jumps nowhere else."""

    discrete: ClassVar[bool] = False
    """Whether the numbers ``directions[k] . w`` affect the cost only through the events."""

    @abstractmethod
    def events(self, theta: np.ndarray, w: np.ndarray) -> Events:
        """Return the events at ``theta (d,)`` with noise ``w (n_w, B)``."""


def half_spaces(normals: np.ndarray, offsets: np.ndarray, sigma: float, theta: np.ndarray, w: np.ndarray) -> Events:
    """Return the events that theta + sigma w is where ``normals[k] . x >= offsets[k]``, for normals ``(K, d)``.

    >>> half_spaces(np.array([[2.0]]), np.array([1.0]), 0.5, np.array([1.0]), np.zeros((1, 1))).limits
    array([[1.]])
    """
    sizes = np.linalg.norm(normals, axis=1)
    units = normals / sizes[:, None]
    limits = (units @ np.reshape(theta, -1) - offsets / sizes) / sigma
    directions = np.zeros((len(units), w.shape[0]))
    directions[:, : units.shape[1]] = -units
    count = w.shape[1]
    return Events(
        directions, np.repeat(limits[:, None], count, axis=1), np.repeat(units[:, :, None] / sigma, count, axis=2)
    )
