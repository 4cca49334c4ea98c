"""Point masses on vertical slides over a spring floor, stepped by semi-implicit Euler."""

import numpy as np


class Model:
    """One program's model."""

    takes_forces = True

    def __init__(self, program):
        self.dt, self.bodies = program["dt"], program["bodies"]
        self.stiffness = program["contact"]["stiffness"]
        if len(self.bodies) != 1 or program["contact"]["damping"]:
            raise NotImplementedError("one body and no damping only")
        self.mass, self.gravity = self.bodies[0]["mass"], program["gravity"][2]
        self.offset = self.bodies[0]["centre"][2] - self.bodies[0]["radius"]

    def step(self, x, u):
        """Return the next states."""
        q, v = x
        force = self.stiffness * np.maximum(0.0, -(q + self.offset)) + u[0]
        v = v + self.dt * (force / self.mass + self.gravity)
        return np.stack([q + self.dt * v, v])

    def jacobians(self, x, u):
        """Return the derivatives of a step."""
        slope = -self.dt * self.stiffness / self.mass * (x[0] + self.offset < 0)
        one = np.ones_like(slope)
        a = np.array([[one + self.dt * slope, self.dt * one], [slope, one]])
        return a, np.stack([self.dt**2 / self.mass * one, self.dt / self.mass * one])[:, None]
