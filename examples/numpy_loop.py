"""A NumPy loop with a gradient by hand: a ball on a spring floor, and a gradient that forgets the damper."""

import numpy as np

MASS, STIFFNESS, DAMPING, DT, STEPS = 1.0, 1e3, 5.0, 1e-3, 400
theta = np.array([0.3, 0.5])  # first height [m] and speed [m/s]


def rollout(theta, forget=False):
    """Return the last height and its derivative by theta."""
    x, v = theta
    dx, dv = np.array([1.0, 0.0]), np.array([0.0, 1.0])
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


def gradient(theta):
    """Its derivative, through every step."""
    x, dx = rollout(theta)
    return 2 * (x - 0.1) * dx


def forgetful(theta):
    """The same without the damper's share."""
    x, dx = rollout(theta, forget=True)
    return 2 * (x - 0.1) * dx


if __name__ == "__main__":
    import bench

    for function in (gradient, forgetful):
        print(bench.examine(cost, theta, grad=function, sigma=[0.01, 0.1], budget="60s"), end="\n\n")
