"""Newton, a particle on the ground by two of its solvers and Warp's tape: 256 worlds, a column of theta each."""

import newton
import numpy as np
import warp as wp

import bench

theta, WIDTH = [0.5, -1.0], 256  # first height of the centre [m] and speed [m/s]; columns at once
one, builder = newton.ModelBuilder(), newton.ModelBuilder()
one.add_particle(pos=(0, 0, 0), vel=(0, 0, 0), mass=1.0, radius=0.1)
builder.replicate(one, WIDTH, spacing=(1, 0, 0))
builder.add_ground_plane()
model = builder.finalize(requires_grad=True)
model.soft_contact_ke, model.soft_contact_kd = 1e3, 1.0
pipeline = newton.CollisionPipeline(model, soft_contact_gap=10.0, requires_grad=True)


def rollout(columns, solver):
    """Return costs and gradients by a solver, `(3, B)`: squared distance of the height after 0.4 s to 0.3 m."""
    states, contacts = [model.state() for _ in range(201)], pipeline.contacts()
    full = np.pad(columns, ((0, 0), (0, WIDTH - columns.shape[1])), "edge")
    for first, row in zip((states[0].particle_q, states[0].particle_qd), full, strict=True):
        first.assign(first.numpy() * [1, 1, 0] + row[:, None] * [0, 0, 1])
    pipeline.collide(states[0], contacts)  # the pairs, once: the solver measures their distance
    with wp.Tape() as tape:
        for t in range(200):
            solver.step(states[t], states[t + 1], None, contacts, 2e-3)
    away = states[-1].particle_q.numpy()[:, 2] - np.float32(0.3)
    tape.backward(grads={states[-1].particle_q: wp.array(np.eye(3)[2] * 2 * away[:, None], dtype=wp.vec3)})
    slopes = [first.grad.numpy()[:, 2] for first in (states[0].particle_q, states[0].particle_qd)]
    return np.array([away**2, *slopes])[:, : columns.shape[1]]


if __name__ == "__main__":
    for name in "SemiImplicit", "XPBD":
        solver = getattr(newton.solvers, f"Solver{name}")(model)
        cost, slope = lambda x, s=solver: rollout(x, s)[0], lambda x, s=solver: rollout(x, s)[1:]
        settings = {"sigma": [0.003, 0.05], "budget": 120, "batch": "columns", "name": f"Newton {name}"}
        print(bench.examine(cost, theta, slope, **settings), end="\n\n")
