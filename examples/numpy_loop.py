"""A NumPy loop with a gradient by hand: a ball on a spring floor, and a gradient that forgets the damper."""

import numpy as np

MASS, STIFFNESS, DAMPING, DT, STEPS = 1.0, 1e3, 5.0, 1e-3, 400
theta = np.array([0.3, 0.5])  # first height [m] and speed [m/s]


def rollout(theta, forget=False):
    """Return the last height and its derivative."""
    (x, v), (dx, dv) = theta, np.eye(2)
    for _ in range(STEPS):
        touching = float(x < 0)
        force = -9.81 * MASS - touching * (STIFFNESS * x + DAMPING * v)
        slope = -touching * (STIFFNESS * dx + (0 if forget else DAMPING) * dv)
        v, dv = v + DT * force / MASS, dv + DT * slope / MASS
        x, dx = x + DT * v, dx + DT * dv
    return x, dx


def cost(theta):
    """Squared distance of the last height to 10 cm."""
    return (rollout(theta)[0] - 0.1) ** 2


def gradient(theta, forget=False):
    """Its derivative, through every step."""
    return 2 * (rollout(theta)[0] - 0.1) * rollout(theta, forget)[1]


def forgetful(theta):
    """The same without the damper's share."""
    return gradient(theta, forget=True)


if __name__ == "__main__":
    import bench

    for function in (gradient, forgetful):
        print(bench.examine(cost, theta, grad=function, sigma=[0.01, 0.1]))
