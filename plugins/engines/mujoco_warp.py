"""MuJoCo's engine on Warp: a world per column, without derivatives."""

import mujoco
import mujoco_warp
import numpy as np
import warp as wp
from mujoco_twin import mujoco_model

wp.config.quiet = True


class Model:
    """A twin as a batch of worlds, one for each width."""

    takes_forces = True
    widths = (1, 64, 512)

    def __init__(self, program):
        self._mujoco = mujoco_model(program)
        bit = mujoco.mjtDisableBit
        self._mujoco.opt.disableflags |= int(bit.mjDSBL_WARMSTART | bit.mjDSBL_EULERDAMP | bit.mjDSBL_REFSAFE)
        self._model, self._data = mujoco_warp.put_model(self._mujoco), {}
        self.device = str(wp.get_device())
        self.settings = {"deterministic": getattr(wp.config, "deterministic", "not an option")}

    def step(self, x, u):
        """Return the states after one step."""
        n, width = self._mujoco.nq, x.shape[1]
        if width not in self._data:
            self._data[width] = mujoco_warp.put_data(self._mujoco, mujoco.MjData(self._mujoco), nworld=width)
        data = self._data[width]
        data.qpos.assign(np.ascontiguousarray(x[:n].T, dtype=np.float32))
        data.qvel.assign(np.ascontiguousarray(x[n:].T, dtype=np.float32))
        data.ctrl.assign(np.ascontiguousarray(u.T, dtype=np.float32))
        mujoco_warp.step(self._model, data)
        return np.concatenate([data.qpos.numpy().T, data.qvel.numpy().T]).astype(np.float64)
