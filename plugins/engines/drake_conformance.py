"""Drake in the conformance set: its discrete plant from the MJCF file, differentiated forward by AutoDiffXd."""

import importlib.metadata

import numpy as np
from drake_plant import Plant
from free_bodies import SteppedEngine, differing, without_motors

DIFFERENT = {
    "geom[@condim]": "contacts are its own",
    "geom[@type='plane']": "contacts are its own",
    "joint[@damping]": "springs and dampers of joints are its own",
    "body[@gravcomp]": "no gravity compensation and no fluids",
    "joint[@limited='true']": "limits are its own",
    "joint[@frictionloss]": "no friction loss",
    "equality/": "no equalities of these kinds",
    "tendon/": "no tendons",
    "option[@integrator]": "the integrator is its own",
    "freejoint": "a step adds to quaternions",
}
"""Elements that Drake runs in another way than MuJoCo, or ignores."""


class Engine(SteppedEngine):
    """A plant per case. Rotations come before positions. Motors are forces on their joints."""

    versions = {"drake": importlib.metadata.version("drake")}
    tolerance = 1e-3  # the solver of contacts stops early
    order_q, order_v = np.roll(np.arange(7), -3), np.roll(np.arange(6), -3)

    def build(self, case):
        """Return the plant and the forces of its motors."""
        root, arms = without_motors(case)
        if case.qpos.size != 7 * len(case.data["quaternions"]) != 0:
            raise NotImplementedError("joints of free bodies are not supported")
        self.differs[case.name] = differing(root, DIFFERENT)
        return Plant(root, float(root.find("option").get("timestep"))), arms
