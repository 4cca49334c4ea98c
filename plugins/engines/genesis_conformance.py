"""Genesis in the conformance set: its rigid solver from the MJCF file, differentiated backward through all steps."""

import importlib.metadata

import numpy as np
from free_bodies import differing, without_motors
from genesis_scene import Scene

DIFFERENT = {
    "geom[@condim='1']": "contacts have friction",
    "geom[@condim='4']": "no torsional friction",
    "geom[@condim='6']": "no rolling friction",
    "option[@cone='elliptic']": "no elliptic cones",
    "contact/pair": "no contact pairs",
    "body[@gravcomp]": "no fluids",
    "option[@integrator='RK4']": "the integrator is its own",
    "tendon/": "no tendons",
}
"""Elements that Genesis runs in another way than MuJoCo, or ignores."""


class Engine:
    """A scene per case, with MuJoCo's law of constraints. Motors are forces on their joints."""

    versions = {name: importlib.metadata.version(name) for name in ("genesis-world", "torch")}

    def __init__(self):
        self.differs = {"sparse_chain": "geoms that overlap in the reference pose do not touch"}
        self._built = {}

    def _of(self, case):
        """Return the case's scene, its motors' arms, and the inputs and weights of its rollout."""
        if case.name not in self._built:
            root, arms = without_motors(case)
            self.differs.setdefault(case.name, differing(root, DIFFERENT))
            simulation = {"dt": float(root.find("option").get("timestep"))}
            rigid = {"constraint_timeconst": 0.02, "iterations": 100, "tolerance": 1e-14}
            self._built[case.name] = Scene(root, simulation, rigid), arms
        scene, arms = self._built[case.name]
        weights = np.concatenate([case.data["weights"][term] for term in ("qpos", "qvel")])
        return scene, arms, (case.qpos, case.qvel, case.controls @ arms.T), weights

    def rollout(self, case):
        """Return the cost of a case."""
        scene, _, inputs, weights = self._of(case)
        return float(scene.run(*inputs)[0].detach().numpy().ravel() @ weights)

    def gradient(self, case):
        """Return the derivatives by state and controls."""
        scene, arms, inputs, weights = self._of(case)
        by_q, by_v, by_force = scene.pull(*inputs, weights)
        return {"qpos": by_q, "qvel": by_v, "controls": by_force @ arms}
