"""MuJoCo's engine on Warp in the conformance set: values only."""

import importlib.metadata

import mujoco_warp
import numpy as np
import warp as wp
from mujoco_conformance import Engine as MujocoC

wp.config.quiet = True


class Engine:
    """Rollouts in a world of their own, with the C engine's models."""

    versions = {name: importlib.metadata.version(name) for name in ("mujoco-warp", "warp-lang")}
    tolerance = 1e-4  # float32
    differs = dict.fromkeys(("connect", "connect_fast", "weld"), "no velocity product J-dot v in these rows")

    def rollout(self, case):
        """Return the cost of a case."""
        source, start = MujocoC().start(case)
        model, data = mujoco_warp.put_model(source), mujoco_warp.put_data(source, start)
        for control in case.controls:
            data.ctrl.assign(np.float32(control[None]))
            mujoco_warp.step(model, data)
        return float(case.cost(data.qpos.numpy()[0], data.qvel.numpy()[0]))

    def gradient(self, case):
        """Return no derivatives: it has none."""
        return {}
