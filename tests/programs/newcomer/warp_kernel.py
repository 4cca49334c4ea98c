import numpy as np
import warp as wp

import bench


@wp.kernel
def rollout(theta: wp.array(dtype=wp.float64), loss: wp.array(dtype=wp.float64)):
    q = theta[0]
    v = theta[1]
    h = wp.float64(0.01)
    for _ in range(100):
        v = v - h * wp.float64(9.81) * wp.sin(q)
        q = q + h * v
    loss[0] = q * q


def run(theta):
    theta = wp.array(np.array(theta), dtype=wp.float64, requires_grad=True)
    loss = wp.zeros(1, dtype=wp.float64, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(rollout, dim=1, inputs=[theta], outputs=[loss])
    return theta, loss, tape


def gradient(at):
    theta, loss, tape = run(at)
    tape.backward(loss)
    return theta.grad.numpy()


print(bench.examine(lambda theta: run(theta)[1].numpy()[0], [0.5, 0.1], grad=gradient))
