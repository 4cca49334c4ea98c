"""A discrete plant of Drake, with the derivatives of a step by AutoDiffXd."""

import logging
import xml.etree.ElementTree as ElementTree

import numpy as np
import pydrake.all as drake

logging.getLogger("drake").setLevel(logging.ERROR)


class Plant:
    """The plant of an MJCF file's root, with the contacts of a ``material`` in place of the file's."""

    def __init__(self, root, dt, material=None):
        builder = drake.DiagramBuilder()
        plant, shapes = drake.AddMultibodyPlantSceneGraph(builder, time_step=dt)
        drake.Parser(plant).AddModelsFromString(ElementTree.tostring(root, encoding="unicode"), "xml")
        for shape in shapes.model_inspector().GetAllGeometryIds(drake.Role.kProximity) if material else ():
            shapes.AssignRole(plant.get_source_id(), shape, material, drake.RoleAssign.kReplace)
        plant.SetUseSampledOutputPorts(False)  # then a step is an update of the discrete state
        plant.Finalize()
        diagram = builder.Build()
        self._plant = _Kind(diagram, plant.get_name())
        self._differentiated = _Kind(diagram.ToAutoDiffXd(), plant.get_name())

    def step(self, x, u):
        """Return the states after one step."""
        return np.stack([self._plant.after(*column) for column in zip(x.T, u.T, strict=True)], axis=-1)

    def jacobians(self, x, u):
        """Return the derivatives of one step."""
        n, m, count = len(x), len(u), x.shape[1]
        a, b = np.empty((n, n, count)), np.empty((n, m, count))
        for c in range(count):
            seeds = drake.InitializeAutoDiff(np.concatenate([x[:, c], u[:, c]]))[:, 0]
            slope = drake.ExtractGradient(self._differentiated.after(seeds[:n], seeds[n:])[:, None])
            a[..., c], b[..., c] = slope[:, :n], slope[:, n:]
        return a, b


class _Kind:
    """The plant with numbers of a kind."""

    def __init__(self, diagram, name):
        self._context = diagram.CreateDefaultContext()
        self._plant = diagram.GetSubsystemByName(name)
        self._own = self._plant.GetMyMutableContextFromRoot(self._context)
        self._forces = self._plant.get_applied_generalized_force_input_port()

    def after(self, x, u):
        """Return the state after one step."""
        self._plant.SetPositionsAndVelocities(self._own, x)
        self._forces.FixValue(self._own, u)
        try:
            return np.array(self._plant.EvalUniquePeriodicDiscreteUpdate(self._own).get_vector(0).CopyToVector())
        except RuntimeError as error:  # shapes whose contacts have no derivatives
            raise NotImplementedError(str(error).partition(". ")[0]) from error
