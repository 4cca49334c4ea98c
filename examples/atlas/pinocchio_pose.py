"""Accelerations of a free body by its pose, by `computeABADerivatives` and `dIntegrate`."""

import numpy as np
import pinocchio as pin
from scipy.linalg import expm

about = {
    "package": "pin",
    "python": "plain",
    "requires": "pin",
    "examine": "grad=gradient calls=6000",
    "derivative": "right",
    "how": "the equations of one body",
}
rng = np.random.default_rng(0)
velocity, force, weight, theta = rng.standard_normal((4, 6))
model = pin.Model()
joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "body")
model.appendBodyToJoint(joint, pin.Inertia(2.0, np.zeros(3), np.diag([0.3, 0.5, 0.7])), pin.SE3.Identity())
data, origin = model.createData(), pin.neutral(model)


def cost(d):
    """Return a weighted sum of the accelerations in the body's frame."""
    return float(weight @ pin.aba(model, data, pin.integrate(model, origin, d), velocity, force))


def naive(d):
    """Return the derivative by a tangent step at the pose itself."""
    pin.computeABADerivatives(model, data, pin.integrate(model, origin, d), velocity, force)
    return data.ddq_dq.T @ weight


def gradient(d):
    """Return the derivative by a tangent step at the origin."""
    return pin.dIntegrate(model, origin, d, pin.ArgumentPosition.ARG1).T @ naive(d)


def truth():
    """Return the derivative: the pose turns gravity, and nothing else."""
    turns = [expm(np.cross(np.eye(3), -(theta[3:] + 1e-30j * e))) for e in np.eye(3)]
    return np.r_[0, 0, 0, [(weight[:3] @ turn @ [0, 0, -9.81]).imag / 1e-30 for turn in turns]]
