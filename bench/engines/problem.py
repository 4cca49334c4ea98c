"""A program whose steps an engine in another Python computes and differentiates."""

from __future__ import annotations

import time

import numpy as np

from bench.engines.process import EngineModel
from bench.model import (
    Array,
    Jacobians,
    LoopOps,
    Ops,
    Problem,
    Program,
    Rollout,
    State,
    Trajectory,
    adjoint_gradient,
    rollout,
    slopes,
)

SCORE_STEP = 1e-3
"""Relative step of the differences of a policy by theta, which are exact for policies that are linear in theta."""
_OPS = LoopOps()


class EngineProblem(Problem):
    """Costs of an engine's rollouts, and gradients as adjoint passes over the engine's step Jacobians.

    Policy, costs and noise are the scene's, in NumPy. The engine gets states and controls.
    """

    block = 1 << 10

    def __init__(self, program: Program, model: EngineModel) -> None:
        super().__init__(program)
        self._rolled, self._model = rollout(program), model
        self._first_s: dict[tuple[str, int], float] = {}
        self.engine_s = 0.0
        """Seconds of the engine's own work in all calls, so far."""
        self.pipe_s = 0.0
        """Seconds of all calls so far in which the engine did not work: pipes, copies, and starts of the engine."""
        self.peak_memory_mb = 0.0
        """Largest resident memory of the engine's process, so far."""

    @property
    def settings(self) -> dict[str, str]:
        """The engine's settings that can change its last digits, by name; empty before the first call."""
        return self._model.settings

    def trajectory(self, theta: np.ndarray, w: np.ndarray) -> Trajectory:
        """Return the engine's states ``(T + 1, n, B)`` and the controls ``(T, n_u, B)``."""
        program, theta = self._rolled, np.asarray(theta, dtype=np.float64).reshape(self.dim, -1)
        with np.errstate(all="ignore"):
            moved, state, scanned = program.start(_OPS, theta, w)

            def control(t: int, state: State) -> np.ndarray:
                return np.asarray(program.control(_OPS, moved, state, tuple(x[t] for x in scanned)), dtype=np.float64)

            times, states, controls = range(program.scene.horizon), [np.concatenate(state)], []
            if program.is_open_loop:
                planned = np.stack([control(t, state) for t in times])
                return Trajectory(self.call("rollout", states[0], planned)[0], planned)
            for t in times:
                controls.append(control(t, State(*np.split(states[-1], [program.scene.n_q]))))
                states += self.call("step", states[-1], controls[-1])
            return Trajectory(np.stack(states), np.stack(controls))

    def jacobians(self, theta: np.ndarray, w: np.ndarray) -> Jacobians:
        """Return states, controls and the engine's step Jacobians; NaN from the first state on that is not finite."""
        states, controls = self.trajectory(theta, w)
        shape = (len(controls), states.shape[-1])
        flat = [np.moveaxis(part, 1, 0).reshape(part.shape[1], np.prod(shape)) for part in (states[:-1], controls)]
        a, b = (np.moveaxis(part.reshape(*part.shape[:2], *shape), 2, 0) for part in self.call("jacobians", *flat))
        return Jacobians(states, controls, a, b)

    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        states = self.trajectory(theta, w).states
        with np.errstate(all="ignore"):
            cost = Replayed(self._rolled, states).cost(_OPS, theta, w)
        return np.where(np.isfinite(states).all(axis=(0, 1)), cost, np.nan)

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            path = slopes(self, np.broadcast_to(theta, (self.dim, w.shape[1])), w)
            gradient = adjoint_gradient(self, path)
            return np.where(np.isfinite(path.cost.sum(axis=0)), gradient, np.nan)

    def _score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        states, steps = self.trajectory(theta, w).states, SCORE_STEP * np.maximum(1.0, np.abs(theta))

        def log_probability(scored: np.ndarray) -> np.ndarray:
            return np.asarray(Replayed(self._rolled, states).log_probability(_OPS, theta, scored, w))

        with np.errstate(all="ignore"):
            changes = [np.where(row[:, None], steps, 0.0) for row in np.eye(self.dim)]
            result = np.stack([log_probability(theta + h) - log_probability(theta - h) for h in changes]) / (2 * steps)
        return np.where(np.isfinite(states).all(axis=(0, 1)), result, np.nan)

    def call(self, name: str, *arrays: np.ndarray) -> list[np.ndarray]:
        """Return the arrays of the engine's answer to ``step``, ``rollout`` or ``jacobians``."""
        started = time.perf_counter()
        answer, results = self._model.call(name, *arrays)
        seconds, key = answer["seconds"], (name, answer["width"])
        self.pipe_s += time.perf_counter() - started - seconds
        self.engine_s += seconds
        if answer["is_first"]:
            self._first_s[key] = seconds + (self._model.build_s if not self._first_s else 0.0)
        if key not in self._charged:
            self._charged.add(key)
            self.usage.compile_s += self._first_s.get(key, 0.0)
        self.device = self._model.device
        self.peak_memory_mb = max(self.peak_memory_mb, answer["peak_memory_mb"])
        return results


class Replayed(Rollout):
    """A program whose steps return recorded states ``(T + 1, n, B)``. It can run only once."""

    def __init__(self, program: Rollout, states: np.ndarray) -> None:
        super().__init__(program.scene, program.contact, program.integrator, program.decision)
        self._states = iter(states[1:])

    def step(self, ops: Ops, state: State, u: Array) -> State:
        """Return the next recorded state."""
        return State(*np.split(next(self._states), [self.scene.n_q]))
