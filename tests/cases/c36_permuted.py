"""gradient returned in another order of the joints (free-joint/quaternion order, sorted pytree keys). Right: closed form."""

import numpy as np

theta = np.array([0.5, -1.2, 2.0, 0.7])
k = np.array([1.0, 2.0, 3.0, 4.0])


def cost(x):
    return float(np.sum(k * np.sin(x) + 0.1 * x**3))


def right(x):
    return k * np.cos(x) + 0.3 * np.asarray(x) ** 2


def rolled(x):
    return np.roll(right(x), 1)
