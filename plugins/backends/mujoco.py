"""MuJoCo: the scene's MJCF twin in the C engine, differentiated by chained finite differences of its step."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Backend, Problem, Program, SteppedProblem, central_differences, cores, param

from .. import mjcf


@dataclass(frozen=True)
class Mujoco(Backend):
    """Gradients: adjoint pass over finite-difference Jacobians of each step, or finite differences of rollouts; float64.

    Steps the scene's MJCF twin with MuJoCo's own integrator and contact solver, on all cores. Costs, policy and noise
    are the scene's.
    """

    name = "mujoco"
    uses = (mjcf,)
    requires = ("mujoco",)
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


class MujocoProblem(SteppedProblem):
    """A program stepped by MuJoCo."""

    def __init__(self, program: Program, backend: Mujoco) -> None:
        super().__init__(program)
        self._backend, self.step = backend, backend.step
        self._engine = Engine(mjcf.build(backend, program), self._rolled.scene.substeps)

    def moved(self, first: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """Return the engine's states."""
        return self._engine.rollout(first, controls)

    def step_jacobians(self, states: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return finite-difference Jacobians of the steps (``mjd_transitionFD``)."""
        return self._engine.jacobians(states, controls, self.step, self._backend.differences == "central")

    def engine_contacts(self) -> mjcf.Contacts:
        """Return the contacts of the twin's model."""
        return mjcf.Contacts(mjcf.build(self._backend, self.program))

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        if self._backend.gradient == "rollouts":
            return central_differences(self._value, theta, w, self.step, self.block)
        return super()._grad(theta, w)


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
            # at most two times again
            for refined in range(3):
                # factor between the differences of a step that straddle a switch of contact and the next
                # shorter ones
                step = eps * 0.03**refined
                after, before = differences(data, step), differences(data, -step)
                result[:, straddled] = ((after + before) / 2.0)[:, straddled]
                size = np.abs(np.concatenate([after, before])).max(axis=0)
                # difference of forward and backward differences, relative to the largest entry of their column,
                # that shows a switch within them. Curvature causes 1e-5 at the default step
                straddled &= np.abs(after - before).max(axis=0) > 1e-3 * size
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
