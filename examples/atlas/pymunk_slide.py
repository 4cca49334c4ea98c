"""A box that slides to a stop (costs only)."""

import numpy as np
import pymunk

about = {
    "package": "pymunk",
    "python": "plain",
    "requires": "pymunk",
    "examine": "sigma=0.01 calls=4000",
    "derivative": "none given",
    "how": "an own sum over the steps",
}
theta, DT = np.array([2.0, 0.5]), 0.005  # speed [m/s], friction


def cost(p):
    """Return where the box is after 1 s."""
    space = pymunk.Space()
    space.gravity = (0, -9.81)
    ground = pymunk.Segment(space.static_body, (-20, 0), (20, 0), 0.05)
    body = pymunk.Body(1, float("inf"))
    box = pymunk.Poly.create_box(body, (0.4, 0.4))
    ground.friction, box.friction, body.position, body.velocity = 1.0, float(p[1]), (0, 0.249), (float(p[0]), 0)
    space.add(ground, body, box)
    for _ in range(200):
        space.step(DT)
    return body.position.x


def truth():
    """Return the derivative: the speed falls by mu g dt in each step until it is 0."""
    v, x = theta[0] + np.array([1e-30j, 0]), 0
    drop = 9.81 * DT * (theta[1] + np.array([0, 1e-30j]))
    for _ in range(200):
        x, v = x + DT * v, np.where(v.real > drop.real, v - drop, 0)
    return x.imag / 1e-30
