"""Drake's multibody plant with point contact, differentiated forward by AutoDiffXd, a column at a time."""

import numpy as np
import pydrake.all as drake


class Model:
    """A twin as a plant."""

    takes_forces = True

    def __init__(self, program):
        builder = drake.DiagramBuilder()
        plant, _ = drake.AddMultibodyPlantSceneGraph(builder, time_step=program["dt"])
        self._build(plant, program)
        plant.SetUseSampledOutputPorts(False)  # then a step is an update of the discrete state
        plant.Finalize()
        diagram = builder.Build()
        self._plant = _Plant(diagram, plant.get_name())
        self._differentiated = _Plant(diagram.ToAutoDiffXd(), plant.get_name())

    def _build(self, plant, program):
        plant.mutable_gravity_field().set_gravity_vector(np.array(program["gravity"]))
        law, links = program["contact"], []
        touching = [contact["bodies"] for contact in program["contacts"]]
        for i, body in enumerate(program["bodies"]):
            com, mass = np.array(body["com"]), body["mass"]
            inertia = drake.SpatialInertia.Zero()
            if mass:
                central = drake.RotationalInertia(*body["inertia"])
                inertia = drake.SpatialInertia.MakeFromCentralInertia(mass, com, central)
            link = plant.AddRigidBody(f"body{i}", inertia)
            parent = links[body["parent"]] if body["parent"] >= 0 else plant.world_body()
            kind = drake.PrismaticJoint if body["joint"] == "slide" else drake.RevoluteJoint
            plant.AddJoint(kind(f"joint{i}", parent.body_frame(), link.body_frame(), body["axis"]))
            links.append(link)
            if any(i in pair for pair in touching):
                pose = drake.RigidTransform(np.array(body["centre"]))
                self._add_shape(plant, link, drake.Sphere(body["radius"]), pose, law, program)
        if program["has_ground"]:
            self._add_shape(plant, plant.world_body(), drake.HalfSpace(), drake.RigidTransform(), law, program)

    def _add_shape(self, plant, body, shape, pose, law, program):
        material = drake.ProximityProperties()
        # two compliant bodies are springs in series
        stiffness = 2.0 * law["stiffness"]
        dissipation = program["backend"]["dissipation"]
        drake.AddContactMaterial(dissipation, stiffness, drake.CoulombFriction(0.0, 0.0), material)
        plant.RegisterCollisionGeometry(body, pose, shape, f"shape{body.index()}", material)

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


class _Plant:
    def __init__(self, diagram, name):
        self._context = diagram.CreateDefaultContext()
        self._plant = diagram.GetSubsystemByName(name)
        self._own = self._plant.GetMyMutableContextFromRoot(self._context)
        self._forces = self._plant.get_applied_generalized_force_input_port()

    def after(self, x, u):
        """Return the state after one step, with numbers of the plant's kind."""
        self._plant.SetPositionsAndVelocities(self._own, x)
        self._forces.FixValue(self._own, u)
        return np.array(self._plant.EvalUniquePeriodicDiscreteUpdate(self._own).get_vector(0).CopyToVector())
