import numpy as np

import bench


def cost(theta):  # mass on a spring and damper, semi-implicit Euler
    mass, stiffness = theta
    q, v = 1.0, 0.0
    for _ in range(500):
        v += 0.01 * (-stiffness * q - 0.3 * v) / mass
        q += 0.01 * v
    return (q - 0.2) ** 2


print(bench.examine(cost, np.array([1.0, 4.0]), sigma=0.05))
