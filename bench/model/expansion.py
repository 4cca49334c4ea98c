"""A rollout with the derivatives of its steps and costs, about which optimizers of open-loop controls plan."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np

from bench.model.adjoint import slopes
from bench.model.backend import Backend
from bench.model.manifold import difference, n_changes, retract
from bench.model.ops import Array, Ops, State
from bench.model.optimizer import Expansion, Optimizer
from bench.model.problem import Problem
from bench.model.program import Program, Rollout, rollout

SECOND_STEP = 4e-3
"""Step of second differences relative to max(1, |x|). Their errors are about 1e-10: of fourth order in the step, and rounding."""


@dataclass(frozen=True)
class PathOptimizer(Optimizer):
    """An optimizer of the controls of each step that uses the field ``path`` of the answer."""

    needs: ClassVar[frozenset[str]] = frozenset({"path"})

    def unsupported_reason(self, program: Program) -> str | None:
        """Return the reason if theta is not one control per step; else None."""
        scene = program.scene
        if not isinstance(program, Rollout):
            return f"{self.name} plans the controls of each step, and scene {scene.name} has no time steps"
        if program.decision.names:
            return f"{self.name} plans the controls of each step: theta must be the scene's own, not {list(program.decision.names)}"
        if not program.plans_controls:
            return f"{self.name} plans the controls of each step, which are not theta in scene {scene.name}"
        if program.scene.controls != program.scene.horizon:
            return f"{self.name} plans a control per step, and scene {scene.name} holds each for several: set hold=1"
        return None

    def expansion(self, problem: Problem, backend: Backend, theta: np.ndarray) -> Expansion:
        """Return the rollout of ``theta (d,)`` with its derivatives, which counts as one gradient in the usage.

        Raises :class:`Unsupported` if the backend gives no states, or neither step Jacobians nor steps that NumPy can run.
        """
        return expand(problem, backend, theta)


def expand(problem: Problem, backend: Backend, theta: np.ndarray) -> Expansion:
    """Return the rollout of the controls ``theta (d,)`` without noise, with its derivatives.

    :func:`~bench.model.adjoint.slopes` computes step Jacobians and first derivatives. Second derivatives of costs are
    central differences of fourth order. It counts as one gradient.
    """
    program = rollout(problem.program)
    scene = program.scene
    controls = np.reshape(theta, (scene.horizon, scene.n_u))
    with np.errstate(all="ignore"):
        path = slopes(problem, np.reshape(theta, (-1, 1)), np.zeros((program.n_noise, 1)))
        states = path.states[:, :, 0]
        before, last, k = states[:-1].T, states[-1:].T, n_changes(scene)

        def stage(z: np.ndarray) -> np.ndarray:
            x = retract(scene, np, before, z[:k])
            return np.asarray(0.0 * x[0] + scene.stage_cost(np, x[: scene.n_q], x[scene.n_q :], controls.T + z[k:]))

        def end(z: np.ndarray) -> np.ndarray:
            x = retract(scene, np, last, z)
            return np.asarray(scene.terminal_cost(np, x[: scene.n_q], x[scene.n_q :]))

        scales = np.concatenate(
            [np.ones((k, scene.horizon)) if k != len(before) else np.abs(before), np.abs(controls.T)]
        )
        second = _second_differences(stage, scales)
        at_end = _second_differences(end, np.abs(last) if k == len(last) else np.ones((k, 1)))
    problem.usage.gradients += 1

    def follow(plans: np.ndarray, gains: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _follow(problem, backend, states, plans, gains)

    return Expansion(
        controls, path.a[..., 0], path.b[..., 0], float(path.cost.sum()), path.cost_x[..., 0], path.cost_u[..., 0],
        np.concatenate([second[:, :k, :k], at_end]), second[:, k:, :k], second[:, k:, k:], follow,
    )  # fmt: skip


def _second_differences(function: Callable[[np.ndarray], np.ndarray], size: np.ndarray) -> np.ndarray:
    """Return the second derivatives ``(C, p, p)`` at 0 of ``function: (p, C) -> (C,)``, whose arguments have ``size (p, C)``."""
    steps = SECOND_STEP * np.maximum(1.0, size)
    p, count = steps.shape
    result = np.empty((count, p, p))

    def mixed(i: int, j: int, factor: float) -> np.ndarray:
        total = np.zeros(count)
        for first, other in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            z = np.zeros((p, count))
            z[i] += first * factor * steps[i]
            z[j] += other * factor * steps[j]
            total += first * other * function(z)
        return np.asarray(total / (4.0 * factor**2 * steps[i] * steps[j]))

    for i in range(p):
        for j in range(i + 1):
            # errors of order 2 cancel between two step lengths
            result[:, i, j] = result[:, j, i] = (4.0 * mixed(i, j, 1.0) - mixed(i, j, 2.0)) / 3.0
    return result


# ------------------------------------------------------------------------------------------- rollouts under feedback


class ClosedLoop(Rollout):
    """A rollout under u_t = plan_t + gain_t (x_t - reference_t), without noise.

    Theta consists of the plans of all steps, then the reference states, then the gains.
    """

    def __init__(self, program: Rollout) -> None:
        super().__init__(program.scene, program.contact, program.integrator)
        scene, state = program.scene, program.scene.initial_state(np, program.theta0[:, None])
        rows = (scene.n_u, sum(len(part) for part in state), scene.n_u * n_changes(scene))
        self._ends = [scene.horizon * n for n in itertools.accumulate(rows)]
        self._own_dim = program.dim

    @cached_property
    def dim(self) -> int:
        """Length of plans, reference states and gains."""
        return self._ends[-1]

    @property
    def theta0(self) -> np.ndarray:
        """Return zeros."""
        return np.zeros(self.dim)

    @property
    def n_noise(self) -> int:
        """1: the noise only sets the number of rollouts."""
        return 1

    @property
    def is_open_loop(self) -> bool:
        """False: the controls depend on the states."""
        return False

    @cached_property
    def structure(self) -> tuple[Any, ...]:
        """The key of the computation graph, which differs from the scene's own program."""
        return (*super().structure, ClosedLoop.__name__)

    def start(self, ops: Ops, theta: Array, w: Array) -> tuple[Array, State, tuple[Array, ...]]:
        """Return theta, the initial state, and plans, reference states and gains by step."""
        xp, horizon, count = ops.xp, self.scene.horizon, w.shape[1]
        scanned = []
        for i, j in itertools.pairwise([0, *self._ends]):
            by_step = xp.reshape(theta[i:j], (horizon, (j - i) // horizon, theta.shape[1]))
            scanned.append(xp.broadcast_to(by_step, (*by_step.shape[:2], count)))
        start = self.scene.initial_state(xp, theta[: self._own_dim])
        return theta, State(*(xp.broadcast_to(part, (part.shape[0], count)) for part in start)), tuple(scanned)

    def control(self, ops: Ops, theta: Array, state: State, slices: tuple[Array, ...]) -> Array:
        """Return the plan plus the gains times the change of the state, ``(n_u, B)``."""
        plan, reference, gains = slices
        change = difference(self.scene, ops.xp, ops.xp.concat([state.q, state.v], axis=0), reference)
        by_control = ops.xp.reshape(gains, (self.scene.n_u, -1, gains.shape[1]))
        return plan + ops.xp.sum(by_control * change[None], axis=1)


_closed_loops: WeakKeyDictionary[Problem, Problem] = WeakKeyDictionary()
"""The compiled programs under feedback, by the problem whose rollouts they follow."""


def _follow(
    problem: Problem, backend: Backend, states: np.ndarray, plans: np.ndarray, gains: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return controls ``(T, m, B)`` and costs ``(B,)`` of rollouts that follow ``states (T + 1, n)``, see :class:`Expansion`."""
    if problem not in _closed_loops:
        _closed_loops[problem] = backend.compile(ClosedLoop(rollout(problem.program)))
    closed, count = _closed_loops[problem], plans.shape[2]
    scene = rollout(closed.program).scene
    shared = np.concatenate([states[:-1].ravel(), gains.ravel()])
    theta = np.concatenate([plans.reshape(-1, count), np.repeat(shared[:, None], count, axis=1)])
    problem.usage.rollouts += count
    with np.errstate(all="ignore"):
        path = closed.trajectory(theta, np.zeros((1, count)))
        x, n_q = path.states, scene.n_q
        cost = np.asarray(scene.terminal_cost(np, x[-1, :n_q], x[-1, n_q:]), dtype=np.float64)
        for before, u in zip(x[:-1], path.controls, strict=True):
            cost = cost + scene.stage_cost(np, before[:n_q], before[n_q:], u)
    return path.controls, np.where(np.isfinite(x).all(axis=(0, 1)), cost, np.nan)
