"""A point mass on a vertical slide over a spring floor, stepped by semi-implicit Euler."""

import os
import signal
import time

import numpy as np


class Model:
    """One program's model."""

    takes_forces = True
    settings = {"speed": "slow"}

    def __init__(self, program):
        print("a line that an engine prints while it starts")
        os.write(1, b"and another\n" * 1000)
        self.dt, body = program["dt"], program["bodies"][0]
        self.stiffness, self.mass, self.gravity = program["contact"]["stiffness"], body["mass"], program["gravity"][2]
        self.offset = body["centre"][2] - body["radius"]
        if program["backend"]["fault"] == "no_contact":
            self.stiffness = 0.0
        self.fault = program["backend"]["fault"]
        if len(program["bodies"]) != 1:
            raise NotImplementedError("one body only")

    def step(self, x, u):
        """Return the next states."""
        q, v = x
        force = self.stiffness * np.maximum(0.0, -(q + self.offset)) + u[0]
        v = v + self.dt * (force / self.mass + self.gravity)
        return np.stack([q + self.dt * v, v])

    def jacobians(self, x, u):
        """Return the derivatives of a step."""
        self.fail()
        slope = -self.dt * self.stiffness / self.mass * (x[0] + self.offset < 0)
        one = np.ones_like(slope)
        a = np.array([[one + self.dt * slope, self.dt * one], [slope, one]])
        return a, np.stack([self.dt**2 / self.mass * one, self.dt / self.mass * one])[:, None]

    def fail(self):
        """End, hang or raise, by the fault."""
        if self.fault == "exit":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.fault == "memory":
            self.memory = np.ones(1 << 27)  # 1 GiB
        if self.fault in ("loop", "memory"):
            time.sleep(1000)
        if self.fault == "raise":
            raise ValueError("the engine has a fault")
