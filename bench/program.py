"""Scene x contact law x integrator: the discrete program that a backend runs and differentiates."""

from __future__ import annotations

import copy
import dataclasses
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
        return smooth + scene.contact_acceleration(xp, q, force)

    def carried(self, v: Array) -> Array:
        """The part of the velocity that a step carries over."""
        return self._scene.velocity_factor * v

    def with_impulse(self, before: State, free: State, dt: Any) -> State:
        """The contact-free end state ``free`` corrected by the impulse law, if there is one."""
        if not isinstance(self._law, ImpulseLaw):
            return free
        xp, scene = self.ops.xp, self._scene
        contact = Contact(
            gap=lambda q: scene.gap(xp, q),
            gap_rate=lambda q, v: scene.gap_rate(xp, q, v),
            acceleration=lambda q, force: scene.contact_acceleration(xp, q, force),
            restitution=scene.restitution,
        )
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

    def _rollout(self, ops: Ops, theta: Array, w: Array, theta_scored: Array | None) -> tuple[Array, Array]:
        scene, xp = self.scene, ops.xp
        assert isinstance(scene, MechanicalScene)
        batch, horizon, n_u = w.shape[1], scene.horizon, scene.n_u
        noise = None
        if self.action_noise:
            noise = xp.reshape(w, (horizon, n_u, batch))
        else:
            theta = theta + scene.sigma * w
        planned = scene.planned_controls(xp, theta)
        if planned is not None:
            planned = xp.broadcast_to(planned, (horizon, n_u, batch))
        scanned: list[Array] = [a for a in (planned, noise) if a is not None]
        planned_scored = None if theta_scored is None else scene.planned_controls(xp, theta_scored)
        if planned_scored is not None:
            scanned.append(planned_scored)

        start = scene.initial_state(xp, theta)
        state = State(*(xp.broadcast_to(part, (part.shape[0], batch)) for part in start))
        zero = xp.zeros_like(w[0, :])

        def step(carry: tuple[State, Array, Array], slices: tuple[Array, ...]) -> tuple[State, Array, Array]:
            state, cost, logp = carry
            rest = list(slices)
            u = rest.pop(0) if planned is not None else xp.zeros_like(state.q[:1]) * xp.zeros((n_u, 1), dtype=w.dtype)
            back = scene.feedback(xp, theta, state.q, state.v)
            if back is not None:
                u = u + back
            if noise is not None:
                w_t = rest.pop(0)
                u = u + scene.sigma * w_t
                if theta_scored is not None:
                    scored = scene.feedback(xp, theta_scored, state.q, state.v)
                    if planned_scored is not None:
                        scored = rest.pop(0) if scored is None else scored + rest.pop(0)
                    logp = logp + xp.sum(w_t * scored, axis=0)
            cost = cost + scene.stage_cost(xp, state.q, state.v, u)
            return self.step(ops, state, u), cost, logp

        state, cost, logp = ops.scan(step, (state, zero, zero), tuple(scanned), horizon)
        return cost + scene.terminal_cost(xp, state.q, state.v), logp
