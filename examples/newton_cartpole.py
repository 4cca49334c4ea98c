"""A cart and pole in Newton's Featherstone solver: one tape over all steps reads matrices that later steps overwrote."""

import itertools

import newton
import numpy as np
import warp as wp

import bench

wp.set_device("cpu")
theta = [0.3, 0.5]  # angle of the pole [rad] and its speed [rad/s]
builder = newton.ModelBuilder()
cart = builder.add_link(mass=1.0, inertia=wp.mat33(np.eye(3) * 0.1))
pole = builder.add_link(mass=0.2, com=wp.vec3(0, 0, -0.5), inertia=wp.mat33(np.eye(3) * 0.02))
joints = [builder.add_joint_prismatic(-1, cart, axis=(1, 0, 0)), builder.add_joint_revolute(cart, pole, axis=(0, 1, 0))]
builder.add_articulation(joints)
model = builder.finalize(requires_grad=True)


def rollout(x, steps):
    """Return the cost q1^2 + 0.1 qd1^2 and its gradient; a solver of its own in each step would make it right."""
    states, solver = [model.state() for _ in range(steps + 1)], newton.solvers.SolverFeatherstone(model)
    states[0].joint_q.assign(np.float32([0, x[0]]))
    states[0].joint_qd.assign(np.float32([0, x[1]]))
    with wp.Tape() as tape:
        for before, after in itertools.pairwise(states):
            solver.step(before, after, model.control(), None, 0.01)
    q, qd = states[-1].joint_q.numpy()[1], states[-1].joint_qd.numpy()[1]
    seeds = {states[-1].joint_q: [0, 2 * q], states[-1].joint_qd: [0, 0.2 * qd]}
    tape.backward(grads={array: wp.array(np.float32(seed)) for array, seed in seeds.items()})
    slopes = [float(first.grad.numpy()[1]) for first in (states[0].joint_q, states[0].joint_qd)]
    return float(q * q + np.float32(0.1) * qd * qd), slopes


if __name__ == "__main__":
    cost, one_tape = lambda x, steps=30: rollout(x, steps)[0], lambda x, steps=30: rollout(x, steps)[1]
    settings = {"horizons": [1, 2, 10, 30], "tolerance": 0.01}
    print(bench.examine(cost, theta, one_tape, name="Newton Featherstone, one tape", budget=120, **settings))
