"""The model of a record: named parameters and entries of the initial state of a program, and what is measured of its motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from bench.errors import unknown
from bench.experiment.cell import Cell
from bench.model import Decision, Identified, LoopOps, Rollout, State, compose, rollout

from .. import norm
from . import START, Identify
from .record import evaluate, expressions, read

STEP = 1e-5
"""Step of central differences in the coordinates of unknowns. Its relative error is about 1e-10."""
Push = Callable[[int, np.ndarray, np.ndarray], Any]
"""An acceleration as a function of step, q and v."""


def still(*_: Any) -> float:
    """Return no acceleration."""
    return 0.0


@dataclass(frozen=True)
class Model:
    """A program of which named parameters, and entries of its initial state, are estimated from measurements.

    Fits use one coordinate per unknown: the logarithm, or for an unknown with a ``scale`` its value over that.
    """

    program: Rollout
    names: tuple[str, ...]
    measured: tuple[int, ...]
    """Indices of the measured entries of the state (q, v)."""
    steps: tuple[int, ...]
    """Numbers of the steps after which the entries are measured, from 1."""
    state: Mapping[str, float] = field(default_factory=dict)
    """Entries of the initial state that are not those of the scene."""
    free: tuple[int, ...] = ()
    """Indices of the entries of the initial state that are unknown, after the parameters."""
    scale: np.ndarray = field(default_factory=lambda: np.zeros(1))
    """Scales of the unknowns that have no logarithm, ``(p,)``; 0: fitted by its logarithm."""

    @cached_property
    def values(self) -> np.ndarray:
        """The scene's own values of the unknowns, ``(p,)``."""
        theta = self.program.theta0
        return np.append(theta, self.initial_states(theta[:, None])[list(self.free), 0])

    @property
    def entries(self) -> list[str]:
        """The names of the entries of the state: q0, q1, v0, v1."""
        scene = self.program.scene
        return [f"q{i}" for i in range(scene.n_q)] + [f"v{i}" for i in range(scene.n_v)]

    @cached_property
    def unit(self) -> np.ndarray:
        """The largest size of each entry of the state along the scene's own motion, ``(n,)``."""
        path, _ = self.motion(self.values[:, None])
        return np.maximum(np.abs(path[1:]).max(axis=(0, 2)), 1e-6)

    def places(self, names: Collection[str]) -> tuple[int, ...]:
        """Return the indices of entries of the state; raises :class:`UserError` for an unknown one."""
        entries = self.entries
        for name in names:
            if name not in entries:
                raise unknown(f"entry of the state of scene {self.program.scene.name}:", name, entries)
        return tuple(map(entries.index, names))

    def theta(self, points: np.ndarray) -> np.ndarray:
        """Return the unknowns ``(p, B)`` of coordinates."""
        scale = self.scale[:, None]
        with np.errstate(over="ignore"):
            return np.where(scale, scale * points, np.exp(points))

    def points(self, theta: np.ndarray) -> np.ndarray:
        """Return the coordinates ``(p, B)`` of unknowns."""
        scale = self.scale[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(scale, theta / scale, np.log(theta))

    def scaled(self, theta: np.ndarray) -> Model:
        """Return the model with the sizes in ``theta (p,)`` as scales, where they change the motion noticeably."""
        # the size of an unknown without a logarithm becomes its scale if it is at least a hundredth of the scale
        is_large = np.abs(theta) > 0.01 * np.abs(self.scale)
        return dataclasses.replace(self, scale=np.where(self.scale * is_large, theta, self.scale))

    def with_scales(self, start: np.ndarray) -> Model:
        """Return the model with a scale for each unknown that is no parameter with a positive value and ``start``.

        At a scale, the record differs from that of 0 by a hundredth of its size. An unknown that is not 0 is its own scale.
        """
        p = len(self.names)
        record = self.record(self.values[:, None] + STEP * np.eye(p, p + 1, 1))
        slopes = np.linalg.norm(record[:, 1:] - record[:, :1], axis=0) / STEP
        scale = 0.01 * (norm(record[:, 0]) or 1.0) / np.where(slopes > 0.0, slopes, 1.0)
        scale[: len(start)] *= np.minimum(self.values[: len(start)], start) <= 0.0
        return dataclasses.replace(self, scale=scale).scaled(self.values)

    def _start(self, theta: np.ndarray) -> tuple[Rollout, np.ndarray, State, tuple[np.ndarray, ...]]:
        w = np.zeros((self.program.n_noise, theta.shape[1]))
        program, own, w = self.program.resolved(LoopOps(), theta[: len(self.program.theta0)], w)
        own, state, scanned = program.start(LoopOps(), own, w)
        return program, own, state, scanned

    def initial_states(self, theta: np.ndarray) -> np.ndarray:
        """Return the initial states ``(n, B)`` for ``theta (p, B)``; entries that theta lacks are those of the scene."""
        states, own = np.concatenate(self._start(theta)[2]), len(self.program.theta0)
        states[list(self.places(self.state))] = np.reshape([*self.state.values()], (-1, 1))
        states[list(self.free[: len(theta) - own])] = theta[own:]
        return states

    def simulate(
        self, theta: np.ndarray, x: np.ndarray, begin: np.ndarray, steps: int, push: Push = still, nudge: Any = still
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the states ``(steps, n, B)`` after, and the controls in, each step from ``x (n, B)`` before ``begin (B,)``.

        ``push`` is an additional acceleration ``(n_v, B)`` of a step and state, half a step before and after each step,
        and ``nudge`` an additional control of a step.
        """
        program, own, state, scanned = self._start(theta)
        half = 0.5 * program.scene.dt
        n_q, columns = len(state.q), np.arange(theta.shape[1])
        now, states, controls = State(x[:n_q], x[n_q:]), [], []
        with np.errstate(all="ignore"):
            for s in range(steps):
                at = np.minimum(begin + s, program.scene.horizon - 1)
                u = program.control(LoopOps(), own, now, tuple(part[at, :, columns].T for part in scanned)) + nudge(s)
                now = program.step(LoopOps(), State(now.q, now.v + half * push(s, *now)), u)
                now = State(now.q, now.v + half * push(s + 1, *now))
                states.append(np.concatenate(now))
                controls.append(u)
        return np.stack(states), np.stack(controls)

    def motion(
        self, theta: np.ndarray, push: Push = still, nudge: Any = still, shift: Any = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the path ``(horizon + 1, n, B)`` of ``theta (p, B)`` from a start moved by ``shift``, and its controls."""
        origin = self.initial_states(theta) + shift
        begin = np.zeros(theta.shape[1], dtype=int)
        states, controls = self.simulate(theta, origin, begin, self.program.scene.horizon, push, nudge)
        return np.concatenate([origin[None], states]), controls

    def record(self, theta: np.ndarray, *changes: Any) -> np.ndarray:
        """Return the measurements ``(m, B)`` along whole rollouts of ``theta (p, B)``, see :meth:`motion`."""
        return self.measurements(self.motion(theta, *changes)[0][1:])

    def measurements(self, states: np.ndarray) -> np.ndarray:
        """Return the measurements ``(m, B)`` of the states ``(horizon, n, B)`` after each step."""
        return states[np.array(self.steps) - 1][:, list(self.measured)].reshape(-1, states.shape[2])


def model_of(cell: Cell, refinement: int = 1) -> Model:
    """Return the cell's model, with a time step ``refinement`` times shorter and the same measurements.

    Raises ValueError if an unknown entry of the initial state does not exist.
    """
    own: Any = cell.scene
    settings: Any = cell.study
    role: Any = own if isinstance(own, Identified) else Identified
    scene = dataclasses.replace(own, dt=own.dt / refinement, horizon=own.horizon * refinement)
    names = settings.decision(cell.decision).names or role.unknowns
    program = rollout(compose(scene, cell.contact, cell.integrator, Decision(names)))
    measured = role.measured or tuple(range(scene.n_q))
    first = own.horizon if role.end_only else 1
    steps = range(first * refinement, scene.horizon + 1, refinement)
    state = {entry: float(evaluate(text, {})) for entry, text in expressions(settings.state).items()}
    model = Model(program, names, measured, tuple(steps), state)
    starts = tuple(name for name in cell.decision.names if name.startswith(START))
    free = model.places([name.removeprefix(START) for name in starts])
    return dataclasses.replace(model, names=(*names, *starts), free=free).with_scales(
        program.theta0 if cell.decision.at is None else np.array(cell.decision.at)
    )


def own_record(path: str, settings: Identify, model: Model) -> tuple[Model, np.ndarray]:
    """Return the model with what the study's CSV file measures and when, and these measurements ``(m, 1)``.

    Raises ValueError, with the number of the first line that cannot be used.
    """
    scene, columns = model.program.scene, expressions(settings.measured)
    values, steps = read(path, columns, settings.time, scene.dt, settings.interpolate)
    measured = model.places(columns) or model.measured
    if len(values.columns) != len(measured):
        raise ValueError(
            f"{path} has {len(values.columns)} columns, scene {scene.name} is measured in {len(measured)} positions: name them, "
            "measured={{q0: angle*pi/180, v0: rate}}; numbers need decimal points"
        )
    times = tuple(steps.tolist()) if settings.time else model.steps
    if len(times) != len(values) or not times or not {*times} <= {*model.steps}:
        raise ValueError(
            f"{path} has {len(values)} lines up to step {max(steps, default=0)}, scene {scene.name} is "
            f"measured {len(model.steps)} times, up to step {model.steps[-1]}: set horizon"
        )
    return dataclasses.replace(model, measured=measured, steps=times), values.to_numpy().reshape(-1, 1)
