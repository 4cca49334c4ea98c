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
        self.options, self.n_calls = program["backend"], 0
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
        self.n_calls += 1
        if self.n_calls == 3 or not self.options["marker"]:
            self.fail(self.options["fault"], self.options["marker"])
        slope = -self.dt * self.stiffness / self.mass * (x[0] + self.offset < 0)
        one = np.ones_like(slope)
        a = np.array([[one + self.dt * slope, self.dt * one], [slope, one]])
        return a, np.stack([self.dt**2 / self.mass * one, self.dt / self.mass * one])[:, None]

    def fail(self, fault, marker):
        """End, hang or raise, unless the marker exists."""
        if fault in ("", "no_contact") or (marker and os.path.exists(marker)):
            return
        if marker:
            open(marker, "w").close()
        if fault == "exit":
            os.kill(os.getpid(), signal.SIGKILL)
        if fault == "loop":
            time.sleep(1000)
        if fault == "memory":
            self.memory = np.ones(1 << 27)  # 1 GiB
            time.sleep(1000)
        raise ValueError("the engine has a fault")
