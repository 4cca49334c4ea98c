"""A program whose steps an engine in another Python computes and differentiates."""

from __future__ import annotations

import time

import numpy as np

from bench.engines.process import EngineModel, Reply
from bench.model import Jacobians, LoopOps, Problem, Program, State, Trajectory, adjoint_gradient, rollout, slopes

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
        self.n_calls = 0
        """Number of calls of the engine, so far."""
        self.peak_memory_mb = 0.0
        """Largest resident memory of the engine's process, so far."""

    def trajectory(self, theta: np.ndarray, w: np.ndarray) -> Trajectory:
        """Return the engine's states and the controls."""
        return Trajectory(*self._rollout(np.asarray(theta, dtype=np.float64).reshape(self.dim, -1), w)[:2])

    def jacobians(self, theta: np.ndarray, w: np.ndarray) -> Jacobians:
        """Return states, controls and the engine's step Jacobians; NaN from the first state on that is not finite."""
        states, controls, carries = self._rollout(np.asarray(theta, dtype=np.float64).reshape(self.dim, -1), w)
        horizon, n_u, count = controls.shape
        n = states.shape[1]
        x = np.moveaxis(states[:-1], 1, 0).reshape(n, horizon * count)
        u = np.moveaxis(controls, 1, 0).reshape(n_u, horizon * count)
        valid = np.isfinite(x).all(axis=0) & np.isfinite(u).all(axis=0)
        a, b = np.full((n, n, horizon * count), np.nan), np.full((n, n_u, horizon * count), np.nan)
        if valid.any():
            carried = [np.moveaxis(c[:-1], 1, 0).reshape(c.shape[1], -1)[:, valid] for c in carries]
            a[..., valid], b[..., valid] = self.call("jacobians", x[:, valid], u[:, valid], *carried)
        by_state, by_control = a.reshape(n, n, horizon, count), b.reshape(n, n_u, horizon, count)
        return Jacobians(states, controls, np.moveaxis(by_state, 2, 0), np.moveaxis(by_control, 2, 0))

    @property
    def settings(self) -> dict[str, str]:
        """The engine's settings that can change its last digits, by name; empty before the first call."""
        return self._model.settings

    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return self._cost(*self._rollout(theta, w)[:2])

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            path = slopes(self, np.broadcast_to(theta, (self.dim, w.shape[1])), w)
            gradient = adjoint_gradient(self, path)
            return np.where(np.isfinite(path.cost.sum(axis=0)), gradient, np.nan)

    def _score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return the derivative of sum_t w_t . pi(theta, x_t) / sigma by theta in the policy pi, ``(d, B)``."""
        program, scene = self._rolled, self._rolled.scene
        theta = np.broadcast_to(theta, (self.dim, w.shape[1]))
        with np.errstate(all="ignore"):
            states, controls, _ = self._rollout(theta, w)
            _, _, scanned = program.start(_OPS, theta, w)
            noise = np.asarray(scanned[-1]) / (scene.sigma * (scene.horizon // scene.controls))
            result = np.empty_like(theta)
            flat = np.moveaxis(states[:-1], 1, 0).reshape(states.shape[1], -1)

            def policy(theta: np.ndarray) -> np.ndarray:
                total = np.zeros_like(controls)
                planned = scene.planned_controls(np, theta)
                back = scene.feedback(np, np.tile(theta, (1, scene.horizon)), flat[: scene.n_q], flat[scene.n_q :])
                total = total if planned is None else total + planned
                return total if back is None else total + np.moveaxis(back.reshape(len(back), *total[:, 0].shape), 0, 1)

            for i in range(self.dim):
                step = np.zeros_like(theta)
                step[i] = SCORE_STEP * np.maximum(1.0, np.abs(theta[i]))
                change = policy(theta + step) - policy(theta - step)
                result[i] = (noise * change).sum(axis=(0, 1)) / (2 * step[i])
        return np.where(np.isfinite(states).all(axis=(0, 1)), result, np.nan)

    def start(self, x: np.ndarray) -> list[np.ndarray]:
        """Return the first values ``(k, B)`` of an engine's numbers beside the states x, or an empty list without them."""
        if self._model.has_carry is False:
            return []
        carry = self.call("start", x)
        return carry if self._model.has_carry else []

    def _rollout(self, theta: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Return states ``(T + 1, n, B)`` and controls ``(T, n_u, B)``, and the carries ``(T + 1, k, B)`` if it has some."""
        program, horizon = self._rolled, self._rolled.scene.horizon
        with np.errstate(all="ignore"):
            moved, state, scanned = program.start(_OPS, theta, w)

            def control(t: int, state: State) -> np.ndarray:
                return np.asarray(program.control(_OPS, moved, state, tuple(x[t] for x in scanned)), dtype=np.float64)

            first = np.concatenate(state)
            if program.is_open_loop:
                controls = np.stack([control(t, state) for t in range(horizon)])
                states, *carries = self.call("rollout", first, controls, *self.start(first))
                return states, controls, carries
            path, applied = [[first, *self.start(first)]], []
            for t in range(horizon):
                x, *carry = path[-1]
                applied.append(control(t, State(*np.split(x, [program.scene.n_q]))))
                path.append(self.call("step", x, applied[-1], *carry))
            states, *carries = [np.stack(parts) for parts in zip(*path, strict=True)]
            return states, np.stack(applied), carries

    def _cost(self, states: np.ndarray, controls: np.ndarray) -> np.ndarray:
        scene = self._rolled.scene
        n_q = scene.n_q
        with np.errstate(all="ignore"):
            total = np.asarray(scene.terminal_cost(np, states[-1, :n_q], states[-1, n_q:]), dtype=np.float64)
            for x, u in zip(states[:-1], controls, strict=True):
                total = total + scene.stage_cost(np, x[:n_q], x[n_q:], u)
        return np.where(np.isfinite(states).all(axis=(0, 1)), total, np.nan)

    def call(self, name: str, *arrays: np.ndarray) -> list[np.ndarray]:
        """Return the arrays of the engine's answer to ``step``, ``rollout``, ``jacobians`` or ``pull``."""
        return self._call(name, *arrays).arrays

    def _call(self, name: str, *arrays: np.ndarray) -> Reply:
        started = time.perf_counter()
        reply = self._model.call(name, *arrays)
        self.pipe_s += time.perf_counter() - started - reply.engine_s
        key = (name, reply.width)
        if reply.is_first:
            self._first_s[key] = reply.engine_s + (self._model.build_s if not self._first_s else 0.0)
        if key not in self._charged:
            self._charged.add(key)
            self.usage.compile_s += self._first_s.get(key, 0.0)
        self.device = self._model.device
        self.engine_s += reply.engine_s
        self.n_calls += 1
        self.peak_memory_mb = max(self.peak_memory_mb, reply.peak_memory_mb)
        return reply
