"""Prints derivatives of one bounce by Newton's XPBD solver, from its tape and from differences: PYTHON_OF_NEWTON xpbd_tape.py.

A ball of 1 kg enters the ground at 2 m/s. The derivative is of the velocity after a step by the velocity before it.
"""

import newton
import numpy as np
import warp as wp

DT, RADIUS, STEP = 1 / 480, 0.1, 1e-2


def bounce(restitution, weighting):
    """Return the derivative from two backward passes over one tape, and from central differences."""
    builder = newton.ModelBuilder()
    config = newton.ModelBuilder.ShapeConfig(density=0.0, mu=0.0, kf=0.0, gap=1.0, restitution=restitution)
    builder.add_shape_sphere(builder.add_link(mass=1.0, inertia=wp.mat33(np.eye(3) * 0.004)), radius=RADIUS, cfg=config)
    builder.add_ground_plane(cfg=config)
    model = builder.finalize(requires_grad=True)
    model.set_gravity((0.0, 0.0, 0.0))
    solver = newton.solvers.SolverXPBD(
        model, iterations=1, enable_restitution=restitution > 0, rigid_contact_con_weighting=weighting
    )
    pipeline = newton.CollisionPipeline(model)
    contacts, before = pipeline.contacts(), model.state()

    def after(velocity):
        before.body_q.assign(np.array([[0, 0, RADIUS - 1e-3, 0, 0, 0, 1]], dtype=np.float32))
        before.body_qd.assign(np.array([[0, 0, velocity, 0, 0, 0]], dtype=np.float32))
        pipeline.collide(before, contacts)
        state = model.state()
        with wp.Tape() as tape:
            solver.step(before, state, None, contacts, DT)
        return tape, state

    tape, state = after(-2.0)
    slopes = []
    for _ in range(2):
        tape.zero()
        tape.backward(grads={state.body_qd: wp.array([[0, 0, 1, 0, 0, 0]], dtype=wp.spatial_vector)})
        slopes.append(float(before.body_qd.grad.numpy()[0, 2]))
    ahead, behind = (after(-2.0 + step)[1].body_qd.numpy()[0, 2] for step in (STEP, -STEP))
    return slopes, (ahead - behind) / (2 * STEP)


if __name__ == "__main__":
    wp.config.quiet = True
    for restitution, weighting in ((0.0, False), (0.0, True), (1.0, True)):
        (first, second), difference = bounce(restitution, weighting)
        print(
            f"restitution {restitution:g}, contact weighting {'on' if weighting else 'off'}: tape {first:.3f}, a second pass "
            f"over it {second:.3f}, differences {difference:.3f}"
        )
