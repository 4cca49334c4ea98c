"""A step of an arm with a point contact, by `calcDiff`."""

import crocoddyl
import numpy as np
import pinocchio as pin

about = {
    "package": "crocoddyl",
    "python": "crocoddyl",
    "requires": "crocoddyl pin==4.0.0",
    "examine": "grad=gradient calls=2000",
    "derivative": "right",
    "how": "differences, own contact dynamics",
    "advice": "Wheels of 3.2.1 end in a segmentation fault beside pin 4.1.0, which pip chooses: install `pin==4.0.0`.",
}
model, world, theta = pin.buildSampleModelManipulator(), pin.LOCAL_WORLD_ALIGNED, np.linspace(0.9, -0.3, 12)
data, state, tip = model.createData(), crocoddyl.StateMultibody(model), model.nframes - 1
contacts, costs = crocoddyl.ContactModelMultiple(state, 6), crocoddyl.CostModelSum(state, 6)
contacts.addContact("tip", crocoddyl.ContactModel3D(state, tip, np.zeros(3), world, 6, np.array([0.0, 20.0])))
parts = state, crocoddyl.ActuationModelFull(state), contacts, costs, 0.0, True
step = crocoddyl.IntegratedActionModelEuler(crocoddyl.DifferentialActionModelContactFwdDynamics(*parts), 0.1)
after = step.createData()


def cost(x):
    """Return a weighted sum of the next state."""
    step.calc(after, x, np.arange(6.0))
    return theta @ after.xnext


def gradient(x):
    """Return the derivative by the step's matrix."""
    cost(x)
    step.calcDiff(after, x, np.arange(6.0))
    return after.Fx.T @ theta


def own(x):
    """Return the cost by accelerations that keep the tip in place."""
    q, v = np.split(x, 2)
    rows, _ = pin.computeFrameJacobian(model, data, q, tip, world)[:3], pin.forwardKinematics(model, data, q, v, 0 * v)
    drift = pin.getFrameClassicalAcceleration(model, data, tip, world).linear + 20 * rows @ v
    matrix = np.block([[pin.crba(model, data, q), rows.T], [rows, np.zeros((3, 3))]])
    v = v + 0.1 * np.linalg.solve(matrix, np.r_[np.arange(6.0) - pin.nle(model, data, q, v), -drift])[:6]
    return theta @ np.r_[q + 0.1 * v, v]


def truth():
    """Return the derivative of the own step."""
    return [(own(theta + e) - own(theta - e)) / 2e-5 for e in 1e-5 * np.eye(12)]
