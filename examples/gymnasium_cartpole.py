"""A gymnasium environment by differences alone: how long a linear policy keeps CartPole near its middle."""

import gymnasium
import numpy as np

theta = np.array([-0.1, -0.3, -3.0, -0.6])  # gains of position, speed, angle and turning speed
env = gymnasium.make("CartPole-v1").unwrapped


def cost(theta):
    """Mean squared angle and position over 60 steps from the same start."""
    env.reset(seed=0)
    env.state = np.array([0.3, 0.0, 0.08, 0.0])
    total = 0.0
    for _ in range(60):
        state = np.array(env.state)
        env.step(int(theta @ state < 0))  # the environment takes left or right, nothing between
        env.steps_beyond_terminated = None
        total += state[0] ** 2 + state[2] ** 2
    return total / 60


if __name__ == "__main__":
    import bench

    print(bench.examine(cost, theta, sigma=[0.01, 0.1], budget="60s"))
