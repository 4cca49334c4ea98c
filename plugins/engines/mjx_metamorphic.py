"""MJX in the checks without a reference, in float64. Gaps and loops are those of the C engine's geometry."""

from __future__ import annotations

import contextlib
import io
from typing import Any

import jax
import numpy as np
from mujoco_metamorphic import VERSIONS as MUJOCO
from mujoco_metamorphic import Model as MujocoC

jax.config.update("jax_enable_x64", True)
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

VERSIONS = {"mujoco-mjx": MUJOCO["mujoco"], "jax": jax.__version__}


class Model(MujocoC):
    """A model from MJCF text, compiled when it is first called."""

    jacobian = None  # type: ignore[assignment]

    def __init__(self, mjcf: str) -> None:
        super().__init__(mjcf)
        model, data = mjx.put_model(self.model), mjx.make_data(self.model)
        data = jax.tree.map(lambda leaf: leaf.astype(float) if leaf.dtype.kind == "f" else leaf, data)

        def at(q: Any, v: Any, u: Any) -> Any:
            return data.replace(qpos=q, qvel=v, ctrl=u)

        def step(q: Any, v: Any, u: Any) -> tuple[Any, Any]:
            after = mjx.step(model, at(q, v, u))
            return after.qpos, after.qvel

        def rollout(q: Any, v: Any, controls: Any) -> Any:
            def going(data: Any, u: Any) -> Any:
                after = mjx.step(model, data.replace(ctrl=u))
                return jax.tree.map(lambda new, old: new.astype(old.dtype), after, data), None

            return jax.lax.scan(going, at(q, v, controls[0]), controls)[0]

        self._forward = jax.jit(lambda q, v, u: mjx.forward(model, at(q, v, u)))
        self._step, self._steps, self._rollout = jax.jit(step), jax.jit(jax.vmap(step)), jax.jit(rollout)

    def acceleration(self, q: Any, v: Any, u: Any) -> np.ndarray:
        """Return the accelerations, ``(n_v,)``."""
        return np.array(self._forward(q, v, u).qacc)

    def reference(self, q: Any, v: Any, u: Any) -> np.ndarray:
        """Return the C engine's accelerations."""
        return super().acceleration(q, v, u)

    def step(self, q: Any, v: Any, u: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the next state."""
        return self._step(q, v, u)

    def rollout(self, q: Any, v: Any, controls: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the last state of a rollout."""
        data = self._rollout(q, v, controls)
        return data.qpos, data.qvel

    def steps(self, q: Any, v: Any, u: Any) -> list[np.ndarray]:
        """Return the next states of rows of states, by vmap."""
        return list(self._steps(q, v, u))

    def force(self, q: Any) -> np.ndarray:
        """Return the generalised forces at rest without constraints."""
        return np.array(self._forward(q, np.zeros(self.model.nv), np.zeros(self.model.nu)).qfrc_smooth)
