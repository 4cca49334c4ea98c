"""A Warp kernel with a tape: a ball on a spring floor, one step a launch."""

import numpy as np
import warp as wp

import bench

theta, STEPS = np.array([0.3, 0.5]), 200


@wp.kernel
def step(x: wp.array(dtype=wp.float64), v: wp.array(dtype=wp.float64), t: int):
    """Move the ball by 2 ms."""
    v[t + 1] = v[t] + wp.float64(2e-3) * (wp.float64(1e3) * wp.max(-x[t], wp.float64(0.0)) - wp.float64(9.81))
    x[t + 1] = x[t] + wp.float64(2e-3) * v[t + 1]


def rollout(theta):
    """Return positions, speeds and their tape."""
    x, v = (wp.array(np.r_[first, np.zeros(STEPS)], dtype=wp.float64, requires_grad=True) for first in theta)
    with wp.Tape() as tape:
        for t in range(STEPS):
            wp.launch(step, dim=1, inputs=[x, v, t])
    return x, v, tape


def cost(theta):
    """Squared distance of the last height to 10 cm."""
    return float((rollout(theta)[0].numpy()[-1] - 0.1) ** 2)


def gradient(theta):
    """The tape's adjoint of it."""
    x, v, tape = rollout(theta)
    tape.backward(grads={x: wp.array(np.eye(STEPS + 1)[-1] * 2 * (x.numpy()[-1] - 0.1), dtype=wp.float64)})
    return np.array([x.grad.numpy()[0], v.grad.numpy()[0]])


if __name__ == "__main__":
    print(bench.examine(cost, theta, grad=gradient, sigma=[0.01], budget="90s", name="Warp kernel"))
