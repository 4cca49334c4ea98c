"""MuJoCo's C engine in the conformance set, by differences of whole rollouts."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

TERMS = ("qpos", "qvel", "controls", "parameter")


def place(model: Any, case: Any, prefix: str = "") -> tuple[Any, str, tuple[int, ...]]:
    """Return the object, the field and the index of a case's parameter in a model."""
    element, name, field, index = (case.data["parameter"][key] for key in ("element", "name", "field", "index"))
    if element == "option":
        return model.opt, field, tuple(index)
    kind = "joint" if element == "dof" else element
    number = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), prefix + name)
    return model, field, (model.jnt_dofadr[number] if element == "dof" else number, *index)


class Engine:
    """Rollouts in C. ``options`` replace those of every model, such as ``iterations`` of the solver."""

    versions = {"mujoco": mujoco.__version__}

    def __init__(self, **options: Any) -> None:
        self._options = options
        self._models: dict[str, Any] = {}

    def start(self, case: Any) -> tuple[Any, Any]:
        """Return the case's model with its parameter, and its data at the start."""
        if case.name not in self._models:
            model = mujoco.MjModel.from_xml_path(str(case.model))
            self._models[case.name] = model, mujoco.MjData(model)
        model, data = self._models[case.name]
        owner, field, index = place(model, case)
        if index:
            getattr(owner, field)[index] = case.parameter
        else:
            setattr(owner, field, float(case.parameter))
        for name, value in self._options.items():
            setattr(model.opt, name, value)
        mujoco.mj_resetData(model, data)
        data.qpos, data.qvel = case.qpos, case.qvel
        return model, data

    def rollout(self, case: Any) -> float:
        """Return the cost of a case."""
        model, data = self.start(case)
        for control in case.controls:
            data.ctrl = control
            mujoco.mj_step(model, data)
        return float(case.cost(data.qpos, data.qvel))

    def gradient(self, case: Any) -> dict[str, np.ndarray]:
        """Return the derivatives, by differences."""
        return {term: case.differences(self, term)[0] for term in TERMS}
