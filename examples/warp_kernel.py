"""A Warp kernel with a tape: a ball on a spring floor, one step a launch."""

import numpy as np
import warp as wp

theta = np.array([0.3, 0.5])
STEPS = 200


@wp.kernel
def step(x: wp.array(dtype=wp.float64), v: wp.array(dtype=wp.float64), t: int):
    """Move the ball by 2 ms."""
    depth = wp.max(-x[t], wp.float64(0.0))
    v[t + 1] = v[t] + wp.float64(2e-3) * (wp.float64(1e3) * depth - wp.float64(9.81))
    x[t + 1] = x[t] + wp.float64(2e-3) * v[t + 1]


def rollout(theta):
    """Return the positions and speeds, and the tape that made them."""
    x, v = (wp.zeros(STEPS + 1, dtype=wp.float64, requires_grad=True) for _ in range(2))
    x[:1].assign(theta[:1]), v[:1].assign(theta[1:])
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
    seed = np.zeros(STEPS + 1)
    seed[-1] = 2 * (x.numpy()[-1] - 0.1)
    tape.backward(grads={x: wp.array(seed, dtype=wp.float64)})
    return np.array([x.grad.numpy()[0], v.grad.numpy()[0]])
