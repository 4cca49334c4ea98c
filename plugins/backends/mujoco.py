"""MuJoCo: the scene's MJCF twin in the C engine, differentiated by chained finite differences of its step."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import (
    Array,
    Backend,
    Jacobians,
    Ops,
    Problem,
    Program,
    Rollout,
    State,
    Trajectory,
    cores,
    difference,
    param,
    retract,
    rollout,
)

from .. import mjcf
from .numpy import NumpyProblem
from .torch import TorchOps

SHORTER = 0.03
"""Factor between the differences of a step that straddle a switch of contact and the next shorter ones."""
REFINED = 2
"""Most times that differences are taken again."""
STRADDLED = 1e-3
"""Difference of forward and backward differences, relative to the largest entry of their column, that shows a switch
within them. Curvature causes 1e-5 at the default step."""


@dataclass(frozen=True)
class Mujoco(Backend):
    """Gradients: adjoint pass over finite-difference Jacobians of each step, or finite differences of rollouts; float64.

    Steps the scene's MJCF twin with MuJoCo's own integrator and contact solver, on all cores. Costs, policy and noise
    are the scene's.
    """

    name = "mujoco"
    uses = (mjcf,)
    requires = ("mujoco", "torch")
    provides = Backend.provides | {"physics"}

    gradient: str = param(
        "chain", "chain Jacobians of single steps, or take differences of whole rollouts", choices=("chain", "rollouts")
    )
    differences: str = param("central", "finite differences of a step", choices=("central", "forward"))
    step: float = param(1e-6, "step of the finite differences, in units of the state, or of theta", positive=True)
    impedance: float = param(
        1e-4, "share of other forces that a contact cancels; at 0 it is a spring", low=1e-4, high=0.9999
    )
    integrator: str = param("euler", "MuJoCo's integrator", choices=("euler", "implicitfast"))
    solver: str = param("newton", "MuJoCo's constraint solver", choices=("newton", "cg", "pgs"))
    cone: str = param(
        "pyramidal", "friction cone; a file with elliptic cones needs elliptic", choices=("pyramidal", "elliptic")
    )
    iterations: int = param(100, "maximum iterations of the constraint solver", positive=True)
    ls_iterations: int = param(50, "maximum iterations of the solver's line search", positive=True)
    lean: bool = param(True, "switch off all engine features that the scene does not use")

    def compile(self, program: Program) -> Problem:
        return MujocoProblem(program, self)

    def own_refusal(self, program: Program) -> str | None:
        """Return why the program cannot run: single precision, or a program without a twin; or None."""
        if self.dtype != "float64":
            return "MuJoCo computes in double precision"
        return mjcf.refusal(self, program)


class MujocoProblem(NumpyProblem):
    """A program stepped by MuJoCo."""

    block = 1 << 10

    def __init__(self, program: Program, backend: Mujoco) -> None:
        super().__init__(program, backend.dtype, backend.step)
        self._rolled = rollout(program)
        self._backend = backend
        self._engine = Engine(mjcf.build(backend, program), self._rolled.scene.substeps)
        self._open_loop = self._rolled.is_open_loop

    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        states, _ = self._rollout(theta, w)
        return np.asarray(Recorded(self._rolled, states).cost(self._ops, theta, w))

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        if self._backend.gradient == "rollouts":
            return super()._grad(theta, w)
        path = self.jacobians(theta, w)
        return _reverse(Recorded(self._rolled, path.states, path), theta, w, scored=False)

    def _score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return _reverse(Recorded(self._rolled, self._rollout(theta, w)[0]), theta, w, scored=True)

    def trajectory(self, theta: np.ndarray, w: np.ndarray) -> Trajectory:
        return Trajectory(*self._rollout(np.asarray(theta, dtype=np.float64).reshape(self.dim, -1), w))

    def engine_contacts(self) -> mjcf.Contacts:
        """Return the contacts of the twin's model."""
        return mjcf.Contacts(mjcf.build(self._backend, self.program))

    def jacobians(self, theta: np.ndarray, w: np.ndarray) -> Jacobians:
        """Return states, controls and finite-difference Jacobians of the steps (``mjd_transitionFD``)."""
        theta = np.asarray(theta, dtype=np.float64).reshape(self.dim, -1)
        states, controls = self._rollout(theta, w)
        central = self._backend.differences == "central"
        a, b = self._engine.jacobians(states, controls, self._backend.step, central)
        n_q = self._rolled.scene.n_q
        for t, x in enumerate(states[:-1]):
            ended = self._rolled.scene.has_ended(np, x[:n_q], x[n_q:])
            if ended is not None:
                a[t][..., ended], b[t][..., ended] = np.eye(a.shape[1])[..., None], 0.0
        return Jacobians(states, controls, a, b)

    def _rollout(self, theta: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return states ``(horizon + 1, n, B)`` and controls ``(horizon, n_u, B)``; NaN after the engine has stopped."""
        moved, state, scanned = self._rolled.start(self._ops, theta, w)
        horizon = self._rolled.scene.horizon

        def control(t: int) -> np.ndarray:
            return np.asarray(self._rolled.control(self._ops, moved, state, tuple(x[t] for x in scanned)))

        if self._open_loop:
            controls = np.stack([control(t) for t in range(horizon)])
            return self._engine.rollout(np.concatenate(state), controls), controls
        states, controls_ = [np.concatenate(state)], []
        for t in range(horizon):
            controls_.append(control(t))
            after = State(*np.split(self._engine.rollout(states[-1], controls_[-1][None])[1], [self._rolled.scene.n_q]))
            state = self._rolled.stopped(np, state, after)
            states.append(np.concatenate(state))
        return np.stack(states), np.stack(controls_)


class Engine:
    """A MuJoCo model with one thread and one set of simulation data per core, and ``substeps`` steps per control."""

    def __init__(self, model: Any, substeps: int) -> None:
        import mujoco
        from mujoco.rollout import Rollout

        # by default MuJoCo writes a log file for a diverging rollout; NaN states report the divergence instead
        mujoco.set_mju_user_warning(lambda message: None)
        self._mujoco, self._model, self._substeps = mujoco, model, substeps
        self._data = [mujoco.MjData(model) for _ in range(cores())]
        self._pool = Rollout(nthread=len(self._data))

    def rollout(self, first: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """Return states ``(T + 1, n, B)`` from ``first (n, B)`` under controls ``(T, n_u, B)``.

        MuJoCo stops a rollout at the first state value beyond 1e10. All later states are NaN.
        """
        start = np.concatenate([np.zeros((1, first.shape[1])), first]).T
        controls = np.repeat(np.moveaxis(controls, -1, 0), self._substeps, axis=1)
        kind = int(self._mujoco.mjtState.mjSTATE_CTRL)
        states, _ = self._pool.rollout(
            self._model, self._data, start, controls, control_spec=kind, nstep=controls.shape[1]
        )
        time = self._model.opt.timestep * np.arange(1, controls.shape[1] + 1)
        states[states[:, :, 0] < time - 0.5 * self._model.opt.timestep] = np.nan
        every = states[:, self._substeps - 1 :: self._substeps, 1:]
        return np.concatenate([first[None], np.moveaxis(every, 0, -1)])

    def jacobians(
        self, states: np.ndarray, controls: np.ndarray, eps: float, central: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return each step's derivatives by state ``(T, k, k, B)`` and by control ``(T, k, n_u, B)``, k = 2 n_v.

        Central differences are the mean of forward and backward ones. Where these disagree, a contact switches within
        ``eps``, and shorter differences replace them.
        """
        horizon, n_u, batch = controls.shape
        n = 2 * self._model.nv
        a, b = np.full((batch, horizon, n, n), np.nan), np.full((batch, horizon, n, n_u), np.nan)
        points = np.ascontiguousarray(np.moveaxis(states[:-1], -1, 0))
        inputs = np.ascontiguousarray(np.moveaxis(controls, -1, 0))

        def differences(data: Any, step: float) -> np.ndarray:
            by_state, by_control = np.empty((n, n)), np.empty((n, n_u))
            self._mujoco.mjd_transitionFD(self._model, data, step, False, by_state, by_control, None, None)
            return np.concatenate([by_state, by_control], axis=1)

        def derivative(data: Any) -> np.ndarray:
            if not central:
                return differences(data, eps)
            result, straddled = np.empty((n, n + n_u)), np.ones(n + n_u, dtype=bool)
            for refined in range(REFINED + 1):
                step = eps * SHORTER**refined
                after, before = differences(data, step), differences(data, -step)
                result[:, straddled] = ((after + before) / 2.0)[:, straddled]
                size = np.abs(np.concatenate([after, before])).max(axis=0)
                straddled &= np.abs(after - before).max(axis=0) > STRADDLED * size
                if not straddled.any():
                    break
            return result

        def work(data: Any, columns: np.ndarray) -> None:
            nq = self._model.nq
            for c in columns:
                for t in range(horizon):
                    # all later states are also nonfinite, and their Jacobians remain NaN
                    if not np.isfinite(points[c, t]).all():
                        break
                    data.qpos, data.qvel, data.ctrl = points[c, t, :nq], points[c, t, nq:], inputs[c, t]
                    step_a, step_b = np.split(derivative(data), [n], axis=1)
                    for _ in range(self._substeps - 1):
                        self._mujoco.mj_step(self._model, data)
                        more_a, more_b = np.split(derivative(data), [n], axis=1)
                        step_a, step_b = more_a @ step_a, more_a @ step_b + more_b
                    a[c, t], b[c, t] = step_a, step_b

        shares = np.array_split(np.arange(batch), len(self._data))
        with ThreadPoolExecutor(len(self._data)) as threads:
            list(threads.map(work, self._data, shares))
        return np.moveaxis(a, 0, -1), np.moveaxis(b, 0, -1)


class Recorded(Rollout):
    """A program that replays recorded engine states; with Jacobians, linearised about these states.

    Its cost and gradient equal the cost and gradient of the engine's rollouts: reverse mode through it is the adjoint
    pass lambda_t = A_t^T lambda_{t+1} + ..., including feedback and stage costs.
    """

    def __init__(self, program: Rollout, states: np.ndarray, path: Jacobians | None = None) -> None:
        super().__init__(program.scene, program.contact, program.integrator, program.decision)
        self._states, self._path = states, path
        self._times: Iterator[int] = iter(range(len(states) - 1))

    def step(self, ops: Ops, state: State, u: Array) -> State:
        """Return the next recorded state, linearised if there are Jacobians. The recorded rollout can run only once."""
        t, xp = next(self._times), ops.xp
        after = xp.asarray(self._states[t + 1])
        if self._path is not None:
            moved = difference(self.scene, xp, xp.concat([state.q, state.v]), xp.asarray(self._states[t]))
            change = xp.sum(xp.asarray(self._path.a[t]) * moved[None], axis=1)
            pushed = u - xp.asarray(self._path.controls[t])
            change = change + xp.sum(xp.asarray(self._path.b[t]) * pushed[None], axis=1)
            after = retract(self.scene, xp, after, change)
        n_q = state.q.shape[0]
        return State(after[:n_q], after[n_q:])


def _reverse(program: Program, theta: np.ndarray, w: np.ndarray, scored: bool) -> np.ndarray:
    """Return the derivative of column b of the cost, or of the log-probability, by column b of theta, ``(d, B)``."""
    import torch

    fixed, noise = torch.tensor(theta.copy()), torch.tensor(w.copy())
    free = torch.tensor(np.broadcast_to(theta, (theta.shape[0], w.shape[1])).copy(), requires_grad=True)
    ops = TorchOps()
    result = program.log_probability(ops, fixed, free, noise) if scored else program.cost(ops, free, noise)
    (gradient,) = torch.autograd.grad(result.sum(), free, materialize_grads=True)
    # torch.where between NaN and a number would have the number's derivative
    return np.asarray(gradient.masked_fill(~torch.isfinite(result.detach()), float("nan")))
