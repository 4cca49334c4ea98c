"""Taichi, a kernel of one's own with its tape: balls on a spring floor, a column of theta each."""

import numpy as np
import taichi as ti

import bench

theta, STEPS, WIDTH = [0.3, -1.0], 200, 256  # height [m] and speed [m/s]; columns at once
ti.init(arch=ti.cpu, default_fp=ti.f64, log_level=ti.ERROR)
x, v = (ti.field(ti.f64, shape=(STEPS + 1, WIDTH), needs_grad=True) for _ in "xv")
total = ti.field(ti.f64, shape=(), needs_grad=True)


@ti.kernel
def step(t: int):
    """Move the balls by 2 ms; at the end, add up the squared distances of their heights to 10 cm."""
    for i in range(WIDTH):
        v[t + 1, i] = v[t, i] + 2e-3 * (1e3 * ti.max(-x[t, i], 0.0) - 9.81)
        x[t + 1, i] = x[t, i] + 2e-3 * v[t + 1, i]
        if t == STEPS - 1:
            total[None] += (x[STEPS, i] - 0.1) ** 2


def rollout(theta):
    """Return the costs and the gradients of the columns of theta, `(3, B)`."""
    for field, row in zip((x, v), theta, strict=True):
        field.from_numpy(np.pad(row[None], ((0, STEPS), (0, WIDTH - row.size))))
    with ti.ad.Tape(total):
        for t in range(STEPS):
            step(t)
    found = np.array([(x.to_numpy()[-1] - 0.1) ** 2, *(field.grad.to_numpy()[0] for field in (x, v))])
    return found[:, : theta.shape[1]]


if __name__ == "__main__":
    settings = {"sigma": [0.003, 0.05], "batch": "columns", "name": "Taichi kernel"}
    print(bench.examine(lambda x: rollout(x)[0], theta, lambda x: rollout(x)[1:], **settings))
