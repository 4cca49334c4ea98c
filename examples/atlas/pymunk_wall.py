"""A ball thrown just over a wall (costs only)."""

import numpy as np
import pymunk

about = {
    "package": "pymunk",
    "python": "plain",
    "requires": "pymunk",
    "examine": "sigma=0.2 calls=4000",
    "derivative": "none given",
    "jumps": "jumps",
    "how": "closed form of the flight, beside hits",
    "advice": "Hits and misses make jumps that no derivative at theta shows: give `sigma` to see them.",
}
theta = np.array([3.0, 5.0])


def cost(p):
    """Return the sum of the ball's coordinates after 1 s."""
    space = pymunk.Space()
    space.gravity = (0, -9.81)
    body = pymunk.Body(1, float("inf"))
    wall = pymunk.Segment(space.static_body, (2, -5), (2, 0.7), 0.05)
    body.velocity = float(p[0]), float(p[1])
    space.add(wall, body, pymunk.Circle(body, 0.2))
    for _ in range(200):
        space.step(0.005)
    return body.position.x + body.position.y


def truth():
    """Return the derivative: each coordinate grows by the time times its speed."""
    return [1.0, 1.0]
