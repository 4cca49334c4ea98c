"""Scene x contact law x integrator: the discrete program that a backend runs and differentiates."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np

from bench.contracts import (
    Array,
    Contact,
    ContactLaw,
    ForceLaw,
    FunctionScene,
    ImpulseLaw,
    Integrator,
    MechanicalScene,
    Ops,
    Plugin,
    Scene,
    State,
    Unsupported,
)


def _traced_fields(plugin: Plugin) -> list[str]:
    return [f.name for f in dataclasses.fields(plugin) if f.type in ("float", float)]


class Dynamics:
    """A scene and its contact law as an integrator sees them."""

    def __init__(self, ops: Ops, scene: MechanicalScene, law: ContactLaw | None) -> None:
        self.ops = ops
        self._scene = scene
        self._law = law

    def acceleration(self, q: Array, v: Array, u: Array) -> Array:
        """v' including the force of a :class:`ForceLaw`, ``(n_v, B)``."""
        xp, scene = self.ops.xp, self._scene
        smooth = scene.acceleration(xp, q, v, u)
        if not isinstance(self._law, ForceLaw):
            return smooth
        force = self._law.force(xp, scene.gap(xp, q), scene.gap_rate(xp, q, v))
        pushed = smooth + scene.contact_acceleration(xp, q, force)
        slip = scene.slip(xp, q, v)
        if slip is None:
            return pushed
        return pushed + scene.friction_acceleration(xp, q, -scene.friction * force * xp.tanh(slip / scene.slip_speed))

    @property
    def contact(self) -> Contact | None:
        """The contact geometry, for integrators that resolve impacts themselves; None without an impulse law."""
        if not isinstance(self._law, ImpulseLaw):
            return None
        xp, scene = self.ops.xp, self._scene
        return Contact(
            gap=lambda q: scene.gap(xp, q),
            gap_rate=lambda q, v: scene.gap_rate(xp, q, v),
            acceleration=lambda q, force: scene.contact_acceleration(xp, q, force),
            restitution=scene.restitution,
        )

    def carried(self, v: Array) -> Array:
        """The part of the velocity that a step carries over."""
        return self._scene.velocity_factor * v

    def with_impulse(self, before: State, free: State, dt: Any) -> State:
        """The contact-free end state ``free`` corrected by the impulse law, if there is one."""
        contact = self.contact
        if contact is None:
            return free
        assert isinstance(self._law, ImpulseLaw)
        change = self._law.impulse(self.ops, contact, before, free, dt)
        return State(free.q + dt * change.v + change.q, free.v + change.v)


class Program:
    """The discrete map theta, w -> cost, written against an array namespace.

    Raises :class:`Unsupported` for combinations that have no meaning. Contact law and integrator are None where
    the scene has none.
    """

    def __init__(self, scene: Scene, contact: ContactLaw | None, integrator: Integrator | None) -> None:
        self.scene = scene
        self.contact = contact
        self.integrator = integrator
        if isinstance(contact, ImpulseLaw) and integrator is not None and not integrator.takes_impulses:
            raise Unsupported(
                f"integrator {integrator.name} has no place for the impulses of contact law {contact.name}"
            )

    # ------------------------------------------------------------------------------------------ structure

    @property
    def parts(self) -> dict[str, Plugin]:
        """The plugins that make the program, by axis."""
        parts = {"scene": self.scene, "contact": self.contact, "integrator": self.integrator}
        return {axis: plugin for axis, plugin in parts.items() if plugin is not None}

    @property
    def needs_root(self) -> bool:
        """Whether a step solves an equation."""
        return any(part is not None and part.needs_root for part in (self.contact, self.integrator))

    @property
    def needs(self) -> frozenset[str]:
        """Capabilities that a backend must provide to run the program: ``root``, ``physics`` or neither."""
        needs = {"root"} if self.needs_root else set()
        if isinstance(self.scene, MechanicalScene) and self.scene.needs_physics:
            needs.add("physics")
        return frozenset(needs)

    @property
    def continuous(self) -> bool:
        """Whether the cost is continuous in theta."""
        return self.scene.continuous and (self.contact is None or self.contact.continuous)

    @cached_property
    def dim(self) -> int:
        """d, the length of theta."""
        return int(self.scene.theta0().size)

    @property
    def action_noise(self) -> bool:
        """Whether noise enters at the actions."""
        return self.scene.noise == "action"

    @property
    def noise_on_theta(self) -> bool:
        """Whether the noise of J is noise on theta, so that the score is w / sigma.

        True of parameter noise, and of action noise where theta is the controls themselves; not under a policy.
        """
        return not self.action_noise or (isinstance(self.scene, MechanicalScene) and self.scene.open_loop)

    @property
    def n_noise(self) -> int:
        """n_w, normal numbers in one rollout."""
        if self.action_noise:
            assert isinstance(self.scene, MechanicalScene)
            return self.scene.horizon * self.scene.n_u
        return self.dim

    @cached_property
    def structure(self) -> tuple[Any, ...]:
        """All that decides the shape of the computation: equal structures differ in :meth:`parameters` alone."""
        parts = []
        for axis, plugin in self.parts.items():
            traced = set(_traced_fields(plugin))
            static = [(f.name, getattr(plugin, f.name)) for f in dataclasses.fields(plugin) if f.name not in traced]
            parts.append((axis, type(plugin), tuple(static)))
        return tuple(parts)

    def parameters(self) -> np.ndarray:
        """The float parameters of all parts, ``(p,)``: what may be traced, and what dF/dp is taken by."""
        return np.array(
            [getattr(plugin, name) for plugin in self.parts.values() for name in _traced_fields(plugin)],
            dtype=np.float64,
        )

    def bind(self, parameters: Any) -> Program:
        """This program with other values, traced ones too, for :meth:`parameters`."""
        bound = copy.copy(self)
        index = 0
        for axis, plugin in self.parts.items():
            twin = copy.copy(plugin)
            for name in _traced_fields(plugin):
                object.__setattr__(twin, name, parameters[index])
                index += 1
            setattr(bound, axis, twin)
        return bound

    # ------------------------------------------------------------------------------------------ evaluation

    def cost(self, ops: Ops, theta: Array, w: Array) -> Array:
        """f(theta, w) for ``theta (d, 1)`` or ``(d, B)`` and ``w (n_w, B)``: ``(B,)``."""
        if isinstance(self.scene, FunctionScene):
            return self.scene.cost(ops.xp, theta + self.scene.sigma * w)
        return self._rollout(ops, theta, w, None)[0]

    def log_probability(self, ops: Ops, theta: Array, theta_scored: Array, w: Array) -> Array:
        """A function of ``theta_scored`` whose gradient at ``theta_scored = theta`` is the score, ``(B,)``.

        sum_t w_t . pi(theta_scored, x_t) / sigma along the states x_t that theta and w lead to: the part of
        log p(actions | states) that is linear in the policy's change.
        """
        return self._rollout(ops, theta, w, theta_scored)[1] / self.scene.sigma

    def step(self, ops: Ops, state: State, u: Array) -> State:
        """One step of the map."""
        assert isinstance(self.scene, MechanicalScene)
        assert self.integrator is not None
        return self.integrator.step(Dynamics(ops, self.scene, self.contact), state, u, self.scene.dt)

    def steps(self, ops: Ops, theta: Array, w: Array) -> Iterator[tuple[State, Array]]:
        """The states before each step with the control applied, one by one; last the end state with that of the last step."""
        theta, state, scanned = self.start(ops, theta, w)
        assert isinstance(self.scene, MechanicalScene)
        u = None
        for t in range(self.scene.horizon):
            u = self.control(ops, theta, state, tuple(x[t] for x in scanned))
            yield state, u
            state = self.step(ops, state, u)
        yield state, u

    def start(self, ops: Ops, theta: Array, w: Array) -> tuple[Array, State, tuple[Array, ...]]:
        """Theta with parameter noise, the initial state, and what the control law takes from each step: (plan, noise)."""
        scene, xp = self.scene, ops.xp
        assert isinstance(scene, MechanicalScene)
        shape = (scene.horizon, scene.n_u, w.shape[1])
        scanned = []
        if self.action_noise:
            scanned.append(xp.reshape(w, shape))
        else:
            theta = theta + scene.sigma * w
        planned = scene.planned_controls(xp, theta)
        if planned is not None:
            scanned.insert(0, xp.broadcast_to(planned, shape))
        start = scene.initial_state(xp, theta)
        state = State(*(xp.broadcast_to(part, (part.shape[0], w.shape[1])) for part in start))
        return theta, state, tuple(scanned)

    def control(self, ops: Ops, theta: Array, state: State, slices: tuple[Array, ...]) -> Array:
        """u_t = plan + feedback + sigma w_t, ``(n_u, B)``."""
        scene, xp = self.scene, ops.xp
        assert isinstance(scene, MechanicalScene)
        parts = list(slices)
        if self.action_noise:
            parts[-1] = scene.sigma * parts[-1]
        back = scene.feedback(xp, theta, state.q, state.v)
        if back is not None:
            parts.append(back)
        return sum(parts[1:], parts[0]) if parts else xp.zeros((scene.n_u, state.v.shape[1]), dtype=state.v.dtype)

    def _rollout(self, ops: Ops, theta: Array, w: Array, theta_scored: Array | None) -> tuple[Array, Array]:
        scene, xp = self.scene, ops.xp
        assert isinstance(scene, MechanicalScene)
        theta, state, scanned = self.start(ops, theta, w)
        planned_scored = None if theta_scored is None else scene.planned_controls(xp, theta_scored)
        extra = () if planned_scored is None else (planned_scored,)
        zero = xp.zeros_like(w[0, :])

        def step(carry: tuple[State, Array, Array], slices: tuple[Array, ...]) -> tuple[State, Array, Array]:
            state, cost, logp = carry
            drawn = slices[: len(scanned)]
            u = self.control(ops, theta, state, drawn)
            if theta_scored is not None:
                scored = [*slices[len(scanned) :], scene.feedback(xp, theta_scored, state.q, state.v)]
                logp = logp + sum(xp.sum(drawn[-1] * part, axis=0) for part in scored if part is not None)
            cost = cost + scene.stage_cost(xp, state.q, state.v, u)
            return self.step(ops, state, u), cost, logp

        state, cost, logp = ops.scan(step, (state, zero, zero), scanned + extra, scene.horizon)
        return cost + scene.terminal_cost(xp, state.q, state.v), logp
