"""MuJoCo's C engine in the conformance set, by differences of whole rollouts, and in the checks without a reference."""

from __future__ import annotations

import functools
from typing import Any

import mujoco
import numpy as np
from mujoco import rollout

TERMS = ("qpos", "qvel", "controls", "parameter")
VERSIONS = {"mujoco": mujoco.__version__}


def place(model: Any, case: Any) -> tuple[Any, str, tuple[int, ...]]:
    """Return the object, the field and the index of a case's parameter in a model."""
    element, name, field, index = (case.data["parameter"][key] for key in ("element", "name", "field", "index"))
    if element == "option":
        return model.opt, field, tuple(index)
    kind = "joint" if element == "dof" else element
    number = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    return model, field, (model.jnt_dofadr[number] if element == "dof" else number, *index)


class Model:
    """A model from MJCF text. Each call starts with data of its own state only."""

    def __init__(self, mjcf: str) -> None:
        self.model = mujoco.MjModel.from_xml_string(mjcf)
        if self.model.na:
            raise NotImplementedError("actuators with activation states are not supported")
        self.data = mujoco.MjData(self.model)
        if self.model.nkey:
            mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        self.start = self.data.qpos.copy(), self.data.qvel.copy()

    def at(self, q: Any, v: Any = 0.0, u: Any = 0.0) -> Any:
        """Return fresh data at a state."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:], self.data.ctrl[:] = q, v, u
        return self.data

    def forward(self, q: Any, v: Any = 0.0, u: Any = 0.0) -> Any:
        """Return data with accelerations, forces and constraints at a state."""
        data = self.at(q, v, u)
        mujoco.mj_forward(self.model, data)
        return data

    def acceleration(self, q: Any, v: Any, u: Any) -> np.ndarray:
        """Return the accelerations, ``(n_v,)``."""
        return np.array(self.forward(q, v, u).qacc)

    def step(self, q: Any, v: Any, u: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the next state."""
        return self.rollout(q, v, np.array([u]))

    def rollout(self, q: Any, v: Any, controls: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the last state of a rollout."""
        data = self.at(q, v)
        for u in controls:
            data.ctrl[:] = u
            mujoco.mj_step(self.model, data)
        return data.qpos.copy(), data.qvel.copy()

    def steps(self, q: Any, v: Any, u: Any) -> list[np.ndarray]:
        """Return the next states of rows of states, by threads."""
        start, data = np.hstack([np.zeros((len(q), 1)), q, v]), [mujoco.MjData(self.model) for _ in range(2)]
        after, _ = rollout.rollout(self.model, data, start, u[:, None], nstep=1)
        return np.split(after[:, 0, 1:], [self.model.nq], axis=1)

    def jacobian(self, q: Any, v: Any, u: Any) -> np.ndarray:
        """Return the derivative of the next state by the state, by differences in C."""
        if self.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            raise NotImplementedError("mjd_transitionFD refuses RK4")
        result = np.empty((2 * self.model.nv, 2 * self.model.nv))
        mujoco.mjd_transitionFD(self.model, self.at(q, v, u), 1e-6, True, result, None, None, None)
        return result

    def _constraints(self, q: Any) -> Any:
        data = self.at(q)
        mujoco.mj_fwdPosition(self.model, data)
        return data

    def gaps(self, q: Any) -> np.ndarray:
        """Return the gaps of contacts and limits that act."""
        data = self._constraints(q)
        is_gap = data.efc_type >= int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)
        return np.array((data.efc_pos - data.efc_margin)[is_gap])

    def loops(self, q: Any) -> np.ndarray:
        """Return the distances of equalities."""
        data = self._constraints(q)
        return np.array(data.efc_pos[data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)])

    def force(self, q: Any) -> np.ndarray:
        """Return the generalised forces at rest without constraints."""
        return np.array(self.forward(q).qfrc_smooth)


class Engine:
    """Rollouts in C. ``options`` replace those of every model, such as ``iterations`` of the solver."""

    versions = VERSIONS

    def __init__(self, **options: Any) -> None:
        self._options = options
        self._made = functools.cache(lambda file: Model(file.read_text()))

    def model(self, case: Any) -> Model:
        """Return the case's model with its parameter."""
        own: Model = self._made(case.model)
        owner, field, index = place(own.model, case)
        value = np.array(getattr(owner, field))
        value[index] = case.parameter
        setattr(owner, field, value)
        for name, value in self._options.items():
            setattr(own.model.opt, name, value)
        return own

    def start(self, case: Any) -> tuple[Any, Any]:
        """Return the case's model with its parameter, and its data at the start."""
        own = self.model(case)
        return own.model, own.at(case.qpos, case.qvel)

    def rollout(self, case: Any) -> float:
        """Return the cost of a case."""
        return float(case.cost(*self.model(case).rollout(case.qpos, case.qvel, case.controls)))

    def gradient(self, case: Any) -> dict[str, np.ndarray]:
        """Return the derivatives, by differences."""
        return {term: case.differences(self, term)[0] for term in TERMS}
