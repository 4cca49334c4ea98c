"""A ball that bounces on a plane (costs only)."""

import numpy as np
import pybullet as p

about = {
    "package": "pybullet",
    "python": "plain",
    "requires": "pybullet",
    "examine": "sigma=0.01 calls=4000",
    "derivative": "none given",
    "jumps": "jumps",
    "how": "own scheme",
    "advice": "The cost jumps where a ball lands a step later: take differences wider than the jumps, or give `sigma` to see them.",
}
theta = np.array([0.4, -1.0])  # height [m], speed [m/s]
p.connect(p.DIRECT)
p.setGravity(0, 0, -9.81)
plane = p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE))
ball = p.createMultiBody(1, p.createCollisionShape(p.GEOM_SPHERE, radius=0.1))
for body, restitution in {plane: 1.0, ball: 0.8}.items():
    p.changeDynamics(body, -1, restitution=restitution, lateralFriction=0, linearDamping=0, angularDamping=0)


def cost(x):
    """Return the height after 60 steps of 1/240 s."""
    p.resetBasePositionAndOrientation(ball, [0, 0, x[0]], [0, 0, 0, 1])
    p.resetBaseVelocity(ball, [0, 0, x[1]], [0, 0, 0])
    for _ in range(60):
        p.stepSimulation()
    return p.getBasePositionAndOrientation(ball)[0][2]


def truth():
    """Return the derivative: the impact has a restitution of 0.8, and removes 8% of the depth beyond 0.01 mm in a step."""
    z, v = (theta + 1e-30j * np.eye(2)).T
    for _ in range(60):
        v = v - 9.81 / 240
        v = np.where((z.real < 0.1) & (v.real < 0), -0.8 * v + 0.08 * 240 * (0.1 - 1e-5 - z), v)
        z = z + v / 240
    return z.imag / 1e-30
