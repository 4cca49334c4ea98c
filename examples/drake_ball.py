"""Drake, a ball dropped on the ground with point contact, differentiated forward by AutoDiffXd."""

import pydrake.all as drake

import bench

theta = [0.5, -1.0]  # first height of the centre [m] and speed [m/s]
builder = drake.DiagramBuilder()
plant, _ = drake.AddMultibodyPlantSceneGraph(builder, time_step=2e-3)
ball = plant.AddRigidBody("ball", drake.SpatialInertia.SolidSphereWithMass(1.0, 0.1))
plant.AddJoint(drake.PrismaticJoint("height", plant.world_frame(), ball.body_frame(), [0, 0, 1]))
for body, shape in (ball, drake.Sphere(0.1)), (plant.world_body(), drake.HalfSpace()):
    material = drake.ProximityProperties()
    drake.AddContactMaterial(0.5, 1e4, drake.CoulombFriction(0.0, 0.0), material)
    plant.RegisterCollisionGeometry(body, drake.RigidTransform(), shape, "shape", material)
plant.Finalize()
diagram = builder.Build()
models = {float: diagram, drake.AutoDiffXd: diagram.ToAutoDiffXd()}


def cost(theta, kind=float):
    """Return the squared distance of the height after 0.4 s to 0.3 m, of either kind of number."""
    model = models[kind]
    simulator = drake.Simulator_[kind](model)
    own, context = model.GetSubsystemByName("plant"), simulator.get_mutable_context()
    own.SetPositionsAndVelocities(own.GetMyMutableContextFromRoot(context), theta)
    simulator.AdvanceTo(0.4)
    return (own.GetPositions(own.GetMyContextFromRoot(context))[0] - 0.3) ** 2


def gradient(theta):
    """Its derivative, carried forward with every number."""
    return cost(drake.InitializeAutoDiff(theta)[:, 0], drake.AutoDiffXd).derivatives()


if __name__ == "__main__":
    print(bench.examine(cost, theta, gradient, sigma=[0.003, 0.05], budget="120s", name="Drake point contact"))
