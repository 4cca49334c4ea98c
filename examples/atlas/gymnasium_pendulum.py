"""A pendulum for 50 steps (costs only)."""

import gymnasium
import numpy as np

about = {
    "package": "gymnasium",
    "python": "bench",
    "requires": "gymnasium",
    "examine": "sigma=0.01 calls=2000",
    "derivative": "none given",
    "how": "the published equations",
}
theta = np.array([1.0, 0.5, 0.3])  # angle [rad], speed [rad/s], torque
env = gymnasium.make("Pendulum-v1").unwrapped


def cost(p):
    """Return minus the sum of rewards."""
    env.reset(seed=0)
    env.state = np.array(p[:2])
    return -sum(float(env.step(np.array([p[2]]))[1]) for _ in range(50))


def truth():
    """Return the derivative; angles are within a turn of 0 for the reward."""
    a, v, u = (theta + 1e-30j * np.eye(3)).T
    total = 0.0
    for _ in range(50):
        total = total + ((a.real + np.pi) % (2 * np.pi) - np.pi + 1j * a.imag) ** 2 + 0.1 * v**2 + 0.001 * u**2
        v = v + 0.05 * (15 * np.sin(a) + 3 * u)
        a = a + 0.05 * v
    return total.imag / 1e-30
