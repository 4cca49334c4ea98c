"""A scene, contact law and integrator composed into the discrete program that a backend runs and differentiates."""

from __future__ import annotations

import copy
import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bench.errors import Unsupported, UserError, unknown
from bench.host.parameters import Plugin, traced
from bench.model.callables import CallableScene
from bench.model.contact import ContactLaw, ImpulseLaw
from bench.model.dynamics import Dynamics
from bench.model.integrator import Integrator
from bench.model.ops import Array, Ops, State
from bench.model.scene import EngineScene, FunctionScene, MechanicalScene, Scene

REVISION = 1
"""Raised when a stored number that this module decides moves."""

SURROGATE = "the gradient is a surrogate, not the derivative of the program"
"""The note in rows, tables and charts if :attr:`Program.surrogate` is true."""


@dataclass(frozen=True)
class Decision:
    """The choice of theta, and the point at which gradients are computed.

    Without ``names``, theta is the scene's own decision variable. With ``names``, theta consists of these float
    parameters of the scene or its contact law, and noise is on theta. A name is ``mass``, or ``pushing.mass`` if scene
    and law both have a parameter ``mass``. ``at`` replaces the scene's own value of theta. ``descent`` is the share of a
    descent from there that is done: a program has no theta0 before that descent is known.
    """

    names: tuple[str, ...] = ()
    at: tuple[float, ...] | None = None
    descent: float = 0.0


OWN_DRAWS = 8
"""Fixed draws of a scene's own noise over which a cost without noise is averaged."""
OWN = Decision()
"""The default decision: the scene's own theta at its own value."""


class Program(ABC):
    """The discrete map (theta, w) -> cost for any array namespace, built by :func:`compose`.

    Contact law and integrator are None if the scene has none.
    """

    def __init__(
        self, scene: Scene, contact: ContactLaw | None, integrator: Integrator | None, decision: Decision = OWN
    ) -> None:
        self.scene = scene
        self.contact = contact
        self.integrator = integrator
        self.decision = decision
        self.named = tuple(self._place(name) for name in decision.names)
        """(axis, name) of the parameters that are theta; empty for the scene's own theta."""
        self._varying: tuple[tuple[str, str], ...] = ()
        """(axis, name) of the parameters whose values are arrays ``(B,)``, set from theta by :meth:`_own_theta`."""
        if isinstance(contact, ImpulseLaw) and integrator is not None and not integrator.takes_impulses:
            raise Unsupported(f"integrator {integrator.name} cannot apply the impulses of contact law {contact.name}")
        # computed before binding, since the parameters of a bound program may be traced values
        self._scene_theta0 = scene.theta0() if self.named else np.empty(0)
        if decision != OWN:
            self._check_decision()

    def _check_decision(self) -> None:
        names, at = list(self.decision.names), self.decision.at
        if len(set(self.named)) < len(names):
            raise UserError(f"theta={names} names a parameter twice")
        if at is not None and len(at) != self.dim:
            raise UserError(f"theta0 has {len(at)} values, theta of scene {self.scene.name} has {self.dim}")
        if not self.decision.descent and not np.isfinite(self.theta0).all():
            raise UserError(f"theta={names} starts at {self.theta0.tolist()}: give finite values by theta0=[..]")

    # ------------------------------------------------------------------------------------------ structure

    @property
    def parts(self) -> dict[str, Plugin]:
        """The plugins of the program, by axis."""
        parts = {"scene": self.scene, "contact": self.contact, "integrator": self.integrator}
        return {axis: plugin for axis, plugin in parts.items() if plugin is not None}

    @property
    def needs_root(self) -> bool:
        """Whether a step solves an equation."""
        return any(part is not None and part.needs_root for part in (self.contact, self.integrator))

    @property
    def needs(self) -> frozenset[str]:
        """Capabilities that a backend must provide to run the program: ``root``, ``physics`` or neither."""
        needs = {"root": self.needs_root, "physics": isinstance(self.scene, EngineScene)}
        return frozenset(name for name, is_needed in needs.items() if is_needed)

    @property
    def continuous(self) -> bool:
        """Whether the cost is continuous in theta."""
        return self.scene.continuous and (self.contact is None or self.contact.continuous)

    @property
    def surrogate(self) -> bool:
        """Whether the contact law replaces the derivative of the program by a surrogate gradient."""
        return self.contact is not None and self.contact.surrogate

    @property
    def theta0(self) -> np.ndarray:
        """The theta at which gradients are computed, ``(d,)``, in an array of the caller's own: cells share the program."""
        return self._theta0.copy()

    @cached_property
    def _theta0(self) -> np.ndarray:
        if self.decision.descent:
            raise Unsupported("theta on a descent is known once the descent is computed")
        if self.decision.at is not None:
            return np.array(self.decision.at, dtype=np.float64)
        if self.named:
            return np.array([getattr(self.parts[axis], name) for axis, name in self.named], dtype=np.float64)
        return self.scene.theta0()

    @cached_property
    def dim(self) -> int:
        """d, the length of theta."""
        return len(self.named) or int(self.scene.theta0().size)

    @property
    def noise(self) -> str:
        """The noise model: ``parameter`` or ``action``; always ``parameter`` if theta consists of named parameters."""
        return "parameter" if self.named else self.scene.noise

    @property
    def action_noise(self) -> bool:
        """Whether noise is on the actions."""
        return self.noise == "action"

    @property
    def noise_on_theta(self) -> bool:
        """Whether the noise in J acts on theta, so that the score is w / sigma.

        True for parameter noise, and for action noise if theta is the sequence of controls. False under a feedback
        policy.
        """
        return not self.action_noise

    @property
    def score_refusal(self) -> str:
        """Why the mean of cost times score is not the gradient; empty if theta affects the cost through noisy numbers only."""
        return ""

    @property
    def exogenous(self) -> int:
        """Number of the scene's own normal numbers, the last rows of w."""
        return self.scene.exogenous

    @property
    def n_noise(self) -> int:
        """n_w, the number of normal numbers per rollout."""
        return self.dim + self.exogenous

    @property
    def noise_free(self) -> np.ndarray:
        """The noise of the cost without noise on theta or actions: ``(n_w, 1)`` zeros.

        For a scene with its own noise, such as a random start: ``(n_w, 8)`` with fixed draws of it, over which the cost
        is averaged.
        """
        if not self.exogenous:
            return np.zeros((self.n_noise, 1))
        own = np.random.default_rng(0).standard_normal((self.exogenous, OWN_DRAWS))
        return np.concatenate([np.zeros((self.n_noise - self.exogenous, OWN_DRAWS)), own])

    @cached_property
    def structure(self) -> tuple[Any, ...]:
        """A key for the computation graph: programs with equal keys differ only in :meth:`parameters`."""
        parts = []
        for axis, plugin in self.parts.items():
            changing = set(traced(plugin))
            static = [(f.name, getattr(plugin, f.name)) for f in dataclasses.fields(plugin) if f.name not in changing]
            parts.append((axis, type(plugin), tuple(static)))
        return (*parts, self.named, self._scene_theta0.tobytes()) if self.named else tuple(parts)

    def parameters(self) -> np.ndarray:
        """Return the float parameters of all plugins, which a backend may trace, ``(p,)``."""
        return np.array(
            [getattr(plugin, name) for plugin in self.parts.values() for name in traced(plugin)], dtype=np.float64
        )

    def bind(self, parameters: Any) -> Program:
        """Return a copy of this program with the values ``parameters (p,)``, possibly traced, see :meth:`parameters`."""
        places = [(axis, name) for axis, plugin in self.parts.items() for name in traced(plugin)]
        return self._with(dict(zip(places, parameters, strict=False)))

    def _with(self, values: dict[tuple[str, str], Any]) -> Program:
        """Return a copy of this program with new parameter values, given by (axis, name)."""
        bound = copy.copy(self)
        for axis, plugin in self.parts.items():
            # plugins are frozen: values are set on a copy that only this program uses
            twin = copy.copy(plugin)
            for name in traced(plugin):
                if (axis, name) in values:
                    object.__setattr__(twin, name, values[axis, name])
            setattr(bound, axis, twin)
        return bound

    def _place(self, name: str) -> tuple[str, str]:
        """Return (axis, parameter) of a name in theta; raises :class:`UserError` if it is unknown or ambiguous."""
        owner, _, parameter = name.rpartition(".")
        parts = {axis: part for axis, part in (("scene", self.scene), ("contact", self.contact)) if part is not None}
        known = {axis: [f for f in traced(part) if f != "sigma"] for axis, part in parts.items()}
        places = [a for a, names in known.items() if parameter in names and owner in ("", a, parts[a].name)]
        if not places:
            names = [f"{parts[a].name}.{f}" if owner else f for a, fields in known.items() for f in fields]
            raise unknown(f"parameter in theta of scene {self.scene.name}:", name, names)
        if len(places) > 1:
            both = " or ".join(f"{parts[axis].name}.{parameter}" for axis in places)
            raise UserError(f"theta names '{name}', a parameter of both scene and contact law: write {both}")
        if places[0] == "scene":
            self._check_moves_program(parameter)
        return places[0], parameter

    def _check_moves_program(self, parameter: str) -> None:
        """Raise :class:`UserError` if a parameter sets the scene's own theta0 only, or nothing, since its derivative would be 0."""
        if parameter in self.scene.without_effect(self.contact):
            raise UserError(f"theta names '{parameter}': {idle(parameter, self.scene, self.contact)}")
        value = getattr(self.scene, parameter)
        if not np.isfinite(value):
            return
        moved = copy.copy(self.scene)
        object.__setattr__(moved, parameter, value * (1 + 1e-6) + 1e-9)
        if not np.array_equal(moved.theta0(), self.scene.theta0()):
            raise UserError(
                f"theta names '{parameter}', which only sets the own theta of scene {self.scene.name}: omit theta "
                "and give theta0=[..]"
            )

    # ----------------------------------------------------------------------------------- known solutions

    @property
    def _as_declared(self) -> bool:
        """Whether theta and theta0 are the scene's own, so that its known solutions apply to this program."""
        at = self.decision.at
        return not (self.named or self.decision.descent) and (
            at is None or bool(np.array_equal(at, self.scene.theta0()))
        )

    def closed_form_gradient(self) -> np.ndarray | None:
        """Return the closed form of grad J_sigma at theta0, ``(d,)``, or None if unknown."""
        return self.scene.closed_form_gradient(self.contact, self.integrator) if self._as_declared else None

    def physical_gradient(self) -> np.ndarray | None:
        """Return grad f of the physics (rigid contact, dt -> 0) at theta0, ``(d,)``, or None if unknown."""
        return self.scene.physical_gradient() if self._as_declared else None

    def physical_cost(self) -> float | None:
        """Return f of the physics (rigid contact, dt -> 0) at theta0, or None if unknown."""
        return self.scene.physical_cost() if self._as_declared else None

    def breakpoints(self) -> tuple[tuple[float, ...], ...]:
        """Return, per coordinate of theta, the known positions of the cost's jumps and kinks."""
        return () if self.named else self.scene.breakpoints()

    # ------------------------------------------------------------------------------------------ evaluation

    @abstractmethod
    def cost(self, ops: Ops, theta: Array, w: Array) -> Array:
        """Return the costs f(theta, w) for ``theta (d, 1)`` or ``(d, B)`` and ``w (n_w, B)``: ``(B,)``."""

    def log_probability(self, ops: Ops, theta: Array, theta_scored: Array, w: Array) -> Array:
        """Return numbers ``(B,)`` whose gradient with respect to ``theta_scored``, at theta, is the score.

        By default, for noise on theta, they are w . theta_scored / sigma.
        """
        return ops.xp.sum(w[: self.dim] * theta_scored, axis=0) / self.scene.sigma

    def _own_theta(self, xp: Any, theta: Array, w: Array) -> tuple[Program, Array]:
        """Return the program with parameters from noisy theta, each ``(B,)``, and the scene's own theta ``(d', B)``."""
        noisy = theta + self.scene.sigma * w
        values = {place: noisy[i] for i, place in enumerate(self.named)}
        bound = self._with(values)
        bound.decision, bound.named, bound._varying = OWN, (), self.named
        bound.__dict__["dim"] = self._scene_theta0.size
        own = xp.asarray(self._scene_theta0[:, None], dtype=noisy.dtype) + 0.0 * noisy[0]
        return bound, own


class FunctionProgram(Program):
    """The program of a scene that is a plain function."""

    scene: FunctionScene

    def cost(self, ops: Ops, theta: Array, w: Array) -> Array:
        """Return the scene's cost at theta + sigma w, ``(B,)``; the scene's own noise follows the first d rows of w."""
        w, own_noise = (w[: self.dim], [w[self.dim :]]) if self.exogenous else (w, [])
        bound, own = self._own_theta(ops.xp, theta, w) if self.named else (self, theta + self.scene.sigma * w)
        assert isinstance(bound.scene, FunctionScene)
        return bound.scene.cost(ops.xp, own, *own_noise)


class CallableProgram(Program):
    """The program of a scene whose cost is a user's own simulator, which no array namespace can run."""

    scene: CallableScene

    def cost(self, ops: Ops, theta: Array, w: Array) -> Array:
        """Raise :class:`Unsupported`: only the backends of the scene can call the simulator."""
        raise Unsupported(
            f"scene {self.scene.name} is a user's own simulator: it runs on {' and '.join(self.scene.backends)} only"
        )


class Rollout(Program):
    """The program of a mechanical scene: ``horizon`` steps of an integrator."""

    scene: MechanicalScene
    integrator: Integrator

    @property
    def noise_on_theta(self) -> bool:
        """Whether noise is on theta: parameter noise, or action noise if theta is only the sequence of controls."""
        # the default control law without feedback: u_t = theta_t + sigma w_t if open-loop
        scene, laws = type(self.scene), ("planned_controls", "feedback")
        is_default = all(getattr(scene, law) is getattr(MechanicalScene, law) for law in laws)
        return not self.action_noise or (scene.open_loop and is_default and not self._moves_start)

    @property
    def is_open_loop(self) -> bool:
        """Whether the control law does not depend on the state."""
        theta, q, v = (np.zeros((n, 1)) for n in (self.dim, self.scene.n_q, self.scene.n_v))
        return self.scene.feedback(np, theta, q, v) is None

    @property
    def score_refusal(self) -> str:
        """Why cost times score is not the gradient: theta sets the initial state and noise is on the actions; or empty."""
        if not (self.action_noise and self._moves_start):
            return ""
        return (
            f"theta sets the initial state of scene {self.scene.name} while noise is on the actions, so that cost times "
            "score is not the gradient: use noise=parameter"
        )

    @cached_property
    def _moves_start(self) -> bool:
        """Whether the initial state depends on theta, tested at theta0 and at random thetas near and far from it."""
        draw = np.random.default_rng(0)
        theta = self.scene.theta0()[:, None]
        # the initial state is compared with that of theta0 at eight random thetas of each size
        sizes = np.repeat([1e-3, self.scene.sigma, 1.0 + float(np.abs(theta).max(initial=0.0))], 8)
        moved = np.concatenate([theta, theta + sizes * draw.standard_normal((theta.size, sizes.size))], axis=1)
        with np.errstate(all="ignore"):
            start = self.scene.initial_state(np, moved)
        return any(not np.array_equal(part, np.broadcast_to(part[:, :1], part.shape), equal_nan=True) for part in start)

    @property
    def n_noise(self) -> int:
        """n_w: for action noise one number per control, else d; then the scene's own numbers."""
        own = self.scene.controls * self.scene.n_u if self.action_noise else self.dim
        return own + self.exogenous

    def cost(self, ops: Ops, theta: Array, w: Array) -> Array:
        """Return the sum of stage costs and terminal cost of each rollout, ``(B,)``."""
        program, theta, w = self.resolved(ops, theta, w)
        return program._rollout(ops, theta, w, None)[0]

    def log_probability(self, ops: Ops, theta: Array, theta_scored: Array, w: Array) -> Array:
        """Return sum_t w_t . pi(theta_scored, x_t) / sigma along the rollout's states x_t, ``(B,)``.

        This is the part of log p(actions) that is linear in the change of the policy pi. The rollout uses theta and w.
        """
        # a held control is drawn once, but the sum contains it at each of its steps
        scale = self.scene.sigma * (self.scene.horizon // self.scene.controls)
        return self._rollout(ops, theta, w, theta_scored)[1] / scale

    def resolved(self, ops: Ops, theta: Array, w: Array) -> tuple[Rollout, Array, Array]:
        """Return program, theta and noise with the named parameters set from theta; unchanged if none are named."""
        if not self.named:
            return self, theta, w
        bound, own = self._own_theta(ops.xp, theta, w[: self.dim])
        assert isinstance(bound, Rollout)
        no_noise = ops.xp.zeros((bound.n_noise - self.exogenous, own.shape[1]), dtype=own.dtype)
        return bound, own, ops.xp.concat([no_noise, w[self.dim :]], axis=0) if self.exogenous else no_noise

    def step(self, ops: Ops, state: State, u: Array) -> State:
        """Return the state after ``substeps`` integrator steps under ``u (n_u, B)``; unchanged after the end."""
        after, n = state, self.scene.substeps
        for _ in range(n):
            after = self.integrator.step(self.dynamics(ops), after, u, self.scene.dt / n if n > 1 else self.scene.dt)
        return self.stopped(ops.xp, state, after)

    def stopped(self, xp: Any, before: State, after: State) -> State:
        """Return the state ``after`` a step, or the state ``before`` it where the rollout had ended."""
        ended = self.scene.has_ended(xp, before.q, before.v)
        if ended is None:
            return after
        return State(*(xp.where(ended, old, new) for old, new in zip(before, after, strict=True)))

    def dynamics(self, ops: Ops) -> Dynamics:
        """Return the scene's dynamics under its contact law, as the integrator uses them."""
        if self._varying and self.needs_root:
            ops = _VaryingOps(ops, [(self.parts[axis], name) for axis, name in self._varying])
        return Dynamics(ops, self.scene, self.contact)

    def path(self, ops: Ops, theta: Array, w: Array) -> tuple[Array, Array]:
        """Return the states ``(horizon + 1, n, B)`` and the controls ``(horizon, n_u, B)`` of rollouts, by a Python loop."""
        program, theta, w = self.resolved(ops, theta, w)
        theta, state, scanned = program.start(ops, theta, w)
        states, controls = [ops.xp.concat(list(state))], []
        for t in range(self.scene.horizon):
            controls.append(program.control(ops, theta, state, tuple(x[t] for x in scanned)))
            state = program.step(ops, state, controls[-1])
            states.append(ops.xp.concat(list(state)))
        return ops.xp.stack(states), ops.xp.stack(controls)

    def start(self, ops: Ops, theta: Array, w: Array) -> tuple[Array, State, tuple[Array, ...]]:
        """Return theta plus its noise, the initial state, and the control law's inputs, each ``(horizon, n_u, B)``.

        The input is the open-loop controls plus the noise on the actions, if there are any.
        """
        scene, xp = self.scene, ops.xp
        own, e = (w[: -self.exogenous], w[-self.exogenous :]) if self.exogenous else (w, None)
        if not self.action_noise:
            theta = theta + scene.sigma * own
        planned = self._planned(xp, theta)
        scanned = [] if planned is None else [xp.broadcast_to(planned, (*planned.shape[:2], w.shape[1]))]
        if self.action_noise:
            noise = scene.sigma * self.drawn_actions(xp, w)
            scanned = [noise if planned is None else planned + noise]
        start = scene.starting_state(xp, theta, e)
        # theta (d, 1) yields a single column, but the scan's carry needs all B columns
        state = State(*(xp.broadcast_to(part, (part.shape[0], w.shape[1])) for part in start))
        return theta, state, tuple(scanned)

    def _planned(self, xp: Any, theta: Array) -> Array | None:
        """Return the open-loop controls, ``(horizon, n_u, B)``, of which a scene may give those of one step for all; or None."""
        planned = self.scene.planned_controls(xp, theta)
        return None if planned is None else xp.broadcast_to(planned, (self.scene.horizon, *planned.shape[1:]))

    def drawn_actions(self, xp: Any, w: Array) -> Array:
        """Return the normal numbers whose multiples by sigma are the noise on the actions, ``(horizon, n_u, B)``."""
        count = self.scene.controls
        return self.scene.held(xp, xp.reshape(w[: count * self.scene.n_u], (count, self.scene.n_u, w.shape[1])))

    def control(self, ops: Ops, theta: Array, state: State, slices: tuple[Array, ...]) -> Array:
        """Return u_t = plan + sigma w_t + feedback, ``(n_u, B)``."""
        scene, xp = self.scene, ops.xp
        back = scene.feedback(xp, theta, state.q, state.v)
        parts = slices if back is None else (*slices, back)
        return sum(parts[1:], parts[0]) if parts else xp.zeros((scene.n_u, state.v.shape[1]), dtype=state.v.dtype)

    def _rollout(self, ops: Ops, theta: Array, w: Array, theta_scored: Array | None) -> tuple[Array, Array]:
        scene, xp = self.scene, ops.xp
        planned_scored = None if theta_scored is None else self._planned(xp, theta_scored)
        drawn = () if theta_scored is None else (self.drawn_actions(xp, w),)
        theta, state, scanned = self.start(ops, theta, w)
        extra = drawn if planned_scored is None else (*drawn, planned_scored)
        # a scan's carry must have a constant shape and type
        zero = xp.zeros_like(w[0, :])

        def step(carry: tuple[State, Array, Array], slices: tuple[Array, ...]) -> tuple[State, Array, Array]:
            state, cost, logp = carry
            u = self.control(ops, theta, state, slices[: len(scanned)])
            if theta_scored is not None:
                noise, *scored = slices[len(scanned) :]
                scored.append(scene.feedback(xp, theta_scored, state.q, state.v))
                logp = logp + sum(xp.sum(noise * part, axis=0) for part in scored if part is not None)
            cost = cost + scene.stage_cost(xp, state.q, state.v, u)
            return self.step(ops, state, u), cost, logp

        state, cost, logp = ops.scan(step, (state, zero, zero), scanned + extra, scene.horizon)
        return cost + scene.terminal_cost(xp, state.q, state.v), logp


class _VaryingOps(Ops):
    """Operations for a program whose named parameters differ between columns.

    A residual reads parameters from the scene and the law, with the values of all columns. A solver that processes
    columns one by one needs the values of one column, so they are passed as arguments of the residual.
    """

    def __init__(self, ops: Ops, places: list[tuple[Plugin, str]]) -> None:
        super().__init__(ops.xp)
        self._ops, self._places = ops, places

    def root(self, residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
        """Return the backend's ``root``, with the parameter values passed as additional arguments."""
        whole = [getattr(plugin, name) for plugin, name in self._places]

        def of_columns(z: Array, both: Any) -> Array:
            own_args, own_values = both
            self._set(own_values)
            try:
                return residual(z, own_args)
            finally:
                self._set(whole)

        return self._ops.root(of_columns, guess, (args, whole))

    def _set(self, values: list[Array]) -> None:
        # the plugins are copies that only this evaluation uses, see Program._with
        for (plugin, name), value in zip(self._places, values, strict=True):
            object.__setattr__(plugin, name, value)


def compose(
    scene: Scene, contact: ContactLaw | None = None, integrator: Integrator | None = None, decision: Decision = OWN
) -> Program:
    """Return the program of a scene, contact law and integrator; law and integrator are None if the scene has none.

    Raises :class:`Unsupported` for an invalid combination and :class:`UserError` for an invalid theta.
    """
    if isinstance(scene, FunctionScene):
        return FunctionProgram(scene, contact, integrator, decision)
    if isinstance(scene, CallableScene):
        return CallableProgram(scene, contact, integrator, decision)
    if isinstance(scene, MechanicalScene):
        return Rollout(scene, contact, integrator, decision)
    raise Unsupported(
        f"scene {scene.name} is neither a FunctionScene, a CallableScene nor a MechanicalScene: derive it from one of these"
    )


def idle(parameter: str, scene: Scene, contact: ContactLaw | None) -> str:
    """Return in words that a parameter of the scene has no effect."""
    law = f" under contact law {contact.name}" if contact is not None else ""
    return f"{parameter} has no effect in scene {scene.name}{law}"


def rollout(program: Program) -> Rollout:
    """Return the program as a :class:`Rollout`; raises :class:`Unsupported` for a plain function."""
    if not isinstance(program, Rollout):
        raise Unsupported(f"scene {program.scene.name} is a plain function: it has no time steps")
    return program
