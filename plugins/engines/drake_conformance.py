"""Drake in the conformance set: its discrete plant from the MJCF file, differentiated forward by AutoDiffXd."""

import importlib.metadata
import logging
import xml.etree.ElementTree as ElementTree

import numpy as np
import pydrake.all as drake
from free_bodies import differing, in_world, without_motors

logging.getLogger("drake").setLevel(logging.ERROR)
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


class Engine:
    """A plant per case. Motors are forces on their joints."""

    versions = {"drake": importlib.metadata.version("drake")}
    tolerance = 1e-3  # the solver of contacts stops early

    def __init__(self):
        self.differs, self._built = {}, {}

    def _build(self, case):
        root, arms = without_motors(case)
        if case.qpos.size != 7 * len(case.data["quaternions"]) != 0:
            raise NotImplementedError("joints of free bodies are not supported")
        self.differs[case.name] = differing(root, DIFFERENT)
        builder = drake.DiagramBuilder()
        plant, _ = drake.AddMultibodyPlantSceneGraph(builder, float(root.find("option").get("timestep")))
        drake.Parser(plant).AddModelsFromString(ElementTree.tostring(root, encoding="unicode"), "xml")
        plant.SetUseSampledOutputPorts(False)
        plant.Finalize()
        diagram = builder.Build()
        return arms, plant.get_name(), (diagram, diagram.ToAutoDiffXd())

    def _cost(self, case, inputs, is_differentiated=False):
        """Return the cost of flat (q, v, u), floats or AutoDiffXd."""
        if case.name not in self._built:
            self._built[case.name] = self._build(case)
        arms, name, diagrams = self._built[case.name]
        root = diagrams[is_differentiated].CreateDefaultContext()
        plant = diagrams[is_differentiated].GetSubsystemByName(name)
        context = plant.GetMyMutableContextFromRoot(root)
        q, v, u = np.split(inputs, np.cumsum([case.qpos.size, case.qvel.size]))
        of_q, of_v = np.arange(q.size), np.arange(v.size)
        if case.data["quaternions"]:  # Drake's rotations come before positions
            of_q, of_v = np.roll(of_q.reshape(-1, 7), -3, 1).ravel(), np.roll(of_v.reshape(-1, 6), -3, 1).ravel()
        v = in_world(case, q, v)
        for control in u.reshape(case.controls.shape):
            plant.SetPositionsAndVelocities(context, np.concatenate([q[of_q], v[of_v]]))
            force = in_world(case, q, arms @ control)[of_v]
            plant.get_applied_generalized_force_input_port().FixValue(context, force)
            try:
                after = plant.EvalUniquePeriodicDiscreteUpdate(context).get_vector(0).CopyToVector()
            except RuntimeError as error:  # shapes whose contacts have no derivatives
                raise NotImplementedError(str(error).partition(". ")[0]) from error
            q, v = np.split(np.array(after), [q.size])
            q, v = q[np.argsort(of_q)], v[np.argsort(of_v)]
        return case.cost(q, in_world(case, q, v, -1))

    def rollout(self, case):
        """Return the cost of a case."""
        return self._cost(case, np.concatenate([case.qpos, case.qvel, case.controls.ravel()]))

    def gradient(self, case):
        """Return the derivatives by state and controls."""
        inputs = drake.InitializeAutoDiff(np.concatenate([case.qpos, case.qvel, case.controls.ravel()]))[:, 0]
        parts = np.split(self._cost(case, inputs, True).derivatives(), np.cumsum([case.qpos.size, case.qvel.size]))
        return dict(zip(("qpos", "qvel", "controls"), parts, strict=True))
