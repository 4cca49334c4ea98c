"""A ball that bounces with friction (LCP)."""

import nimblephysics as nimble
import numpy as np
import torch

torch.set_default_dtype(torch.float64)
about = {
    "package": "nimblephysics",
    "python": "numpy1",
    "requires": "nimblephysics numpy<2 torch==2.13.0",
    "examine": "grad=torch calls=600",
    "derivative": "wrong",
    "how": "own scheme",
    "advice": "At an impact the Jacobian has -restitution for the height by the height before, where the step has 1, so that a gradient through "
    "an impact is not the program's. NumPy 2 ends in a segmentation fault: install `numpy<2`.",
}
theta, DT = np.array([2.0, -1.0]), 5e-3
world = nimble.simulation.World()
world.setGravity([0, -9.81, 0])
world.setTimeStep(DT)
ball, floor = nimble.dynamics.SphereShape(0.1), nimble.dynamics.BoxShape([20, 0.2, 20])
for kind, shape in ("TranslationalJoint2D", ball), ("WeldJoint", floor):
    body = getattr(skeleton := nimble.dynamics.Skeleton(), f"create{kind}AndBodyNodePair")()[1]
    body.createShapeNode(shape).createCollisionAspect()
    body.setFrictionCoeff(0.3)
    body.setRestitutionCoeff(0.5)
    skeleton.setMobile(kind != "WeldJoint")
    world.addSkeleton(skeleton)


def cost(v, steps=50):
    """Return the squared distance from (1, 0.2) after 0.25 s."""
    state = torch.cat([torch.tensor([0.0, 0.5]), torch.as_tensor(v)])
    for _ in range(steps):
        state = nimble.timestep(world, state, torch.zeros(2))
    return (state[0] - 1) ** 2 + (state[1] - 0.2) ** 2


def truth():
    """Return the derivative: restitution 0.25 and friction 0.3 of the impulse, positions move by the speed before."""
    x, y, (vx, vy) = 0.0, 0.5, (theta + 1e-30j * np.eye(2)).T
    for _ in range(50):
        hit, x, y, vy = (np.real(y) < 0.2) & (vy.real < 0), x + DT * vx, y + DT * vy, vy - 9.81 * DT
        vx, vy = np.where(hit, vx + 0.3 * 1.25 * vy, vx), np.where(hit, -0.25 * vy, vy)
    return ((x - 1) ** 2 + (y - 0.2) ** 2).imag / 1e-30
