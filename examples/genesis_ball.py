"""Genesis, a rigid ball dropped on a plane, differentiated by its own tape: sixteen at once, a row of theta each."""

import genesis as gs
import numpy as np
import torch

import bench

theta, WIDTH = [0.5, -1.0], 16  # first height of the centre [m] and speed [m/s]; rows at once
gs.init(backend=gs.cpu, precision="64", logging_level="error")
scene = gs.Scene(sim_options=gs.options.SimOptions(dt=4e-3, requires_grad=True), show_viewer=False)
scene.add_entity(gs.morphs.Plane())
ball = scene.add_entity(gs.morphs.Sphere(radius=0.1, pos=(0.0, 0.0, 0.5)))
scene.build(n_envs=WIDTH)


def some(rows, slope):
    """Return the cost of up to sixteen rows, or its gradient: squared distance of the height after 0.22 s to 0.3 m."""
    scene.reset()
    start = torch.as_tensor(np.pad(rows, ((0, WIDTH - len(rows)), (0, 0)), "edge")).requires_grad_(slope)
    nothing = torch.zeros(WIDTH, 5, dtype=start.dtype)
    ball.set_pos(torch.cat([nothing[:, :2], start[:, :1]], dim=1))
    ball.set_dofs_velocity(torch.cat([nothing[:, :2], start[:, 1:], nothing[:, :3]], dim=1))
    for _ in range(55):
        scene.step()
    cost = (ball.get_state().pos[:, 2] - 0.3) ** 2
    return (torch.autograd.grad(cost.sum(), start)[0] if slope else cost).detach().numpy()[: len(rows)]


def rollout(rows, slope=False):
    """Return the costs of all rows, or the gradients."""
    return np.concatenate([some(rows[i : i + WIDTH], slope) for i in range(0, len(rows), WIDTH)])


if __name__ == "__main__":
    settings = {"sigma": [0.003, 0.05], "budget": "180s", "batch": "rows", "name": "Genesis rigid"}
    print(bench.examine(rollout, theta, lambda x: rollout(x, True), **settings))
