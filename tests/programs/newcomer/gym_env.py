import gymnasium
import numpy as np

import bench

env = gymnasium.make("Pendulum-v1")


def cost(gains):
    (_, s, w), _ = env.reset(seed=0)
    total = 0.0
    for _ in range(100):
        (_, s, w), reward, *_ = env.step(np.clip([-gains[0] * s - gains[1] * w], -2, 2))
        total -= reward
    return total


print(bench.examine(cost, [1.0, 0.2], sigma=0.1))
