"""A program whose steps are computed and differentiated outside the array libraries, such as by a physics engine."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from bench.model.adjoint import controls_by_theta, gradient, slopes
from bench.model.ops import Array, LoopOps, Ops, State
from bench.model.problem import Jacobians, Problem, Trajectory
from bench.model.program import Program, Rollout, rollout

_OPS = LoopOps()


class SteppedProblem(Problem):
    """Costs, gradients and scores in NumPy, from the states of rollouts and the Jacobians of their steps.

    A subclass moves states under controls in :meth:`moved`, and differentiates each step in :meth:`step_jacobians`.
    Policy, costs and noise are the scene's.
    """

    block = 1 << 10

    def __init__(self, program: Program) -> None:
        super().__init__(program)
        self._rolled = rollout(program)
        self._open_loop = self._rolled.is_open_loop

    @abstractmethod
    def moved(self, first: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """Return the states ``(T + 1, n, B)`` from ``first (n, B)`` under controls ``(T, n_u, B)``.

        T is the horizon, or 1 where controls depend on states.
        """

    @abstractmethod
    def step_jacobians(self, states: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return each step's derivatives by state ``(T, k, k, B)`` and by control ``(T, k, n_u, B)``."""

    def trajectory(self, theta: np.ndarray, w: np.ndarray) -> Trajectory:
        """Return the states ``(T + 1, n, B)`` and the controls ``(T, n_u, B)``; NaN after the engine has stopped."""
        program, theta = self._rolled, np.asarray(theta, dtype=np.float64).reshape(self.dim, -1)
        with np.errstate(all="ignore"):
            noisy, state, scanned = program.start(_OPS, theta, w)

            def control(t: int) -> np.ndarray:
                return np.asarray(program.control(_OPS, noisy, state, tuple(x[t] for x in scanned)), dtype=np.float64)

            times, states, controls = range(program.scene.horizon), [np.concatenate(state)], []
            if self._open_loop:
                planned = np.stack([control(t) for t in times])
                return Trajectory(self.moved(states[0], planned), planned)
            for t in times:
                controls.append(control(t))
                after = program.scene.split(self.moved(states[-1], controls[-1][None])[1])
                state = program.stopped(np, state, after)
                states.append(np.concatenate(state))
            return Trajectory(np.stack(states), np.stack(controls))

    def jacobians(self, theta: np.ndarray, w: np.ndarray) -> Jacobians:
        """Return states, controls and step Jacobians; a step after the end changes nothing."""
        states, controls = self.trajectory(theta, w)
        a, b = self.step_jacobians(states, controls)
        for t, x in enumerate(states[:-1]):
            ended = self._rolled.scene.has_ended(np, *self._rolled.scene.split(x))
            if ended is not None:
                a[t][..., ended], b[t][..., ended] = np.eye(a.shape[1])[..., None], 0.0
        return Jacobians(states, controls, a, b)

    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        states = self.trajectory(theta, w).states
        with np.errstate(all="ignore"):
            cost = Replayed(self._rolled, states).cost(_OPS, theta, w)
        return np.where(np.isfinite(states).all(axis=(0, 1)), cost, np.nan)

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            path = slopes(self, np.broadcast_to(theta, (self.dim, w.shape[1])), w)
            return np.where(np.isfinite(path.cost.sum(axis=0)), gradient(self, path), np.nan)

    def _score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        program, states = self._rolled, self.trajectory(theta, w).states
        theta = np.broadcast_to(theta, (self.dim, w.shape[1]))
        # a held control is drawn once and acts at each of its steps
        scale = program.scene.sigma * (program.scene.horizon // program.scene.controls)
        with np.errstate(all="ignore"):
            result = controls_by_theta(program, states, theta, program.drawn_actions(np, w) / scale)
        return np.where(np.isfinite(states).all(axis=(0, 1)), result, np.nan)


class Replayed(Rollout):
    """A program whose steps return recorded states ``(T + 1, n, B)``. It can run only once."""

    def __init__(self, program: Rollout, states: np.ndarray) -> None:
        super().__init__(program.scene, program.contact, program.integrator, program.decision)
        self._states = iter(states[1:])

    def step(self, ops: Ops, state: State, u: Array) -> State:
        """Return the next recorded state."""
        return self.scene.split(next(self._states))
