"""Genesis' rigid solver, all columns together, differentiated backward a step at a time."""

import numpy as np
from genesis_scene import Scene, gs
from twin_bodies import bodies

NEVER = 1e9
"""Time constant [s] of a contact without damping."""


class Model:
    """A twin as a scene of parallel environments, one scene per width."""

    takes_forces = True
    widths = (64, 1024)

    def __init__(self, program):
        self._program, self._scenes = program, {}
        self.device = str(gs.device)

    def _scene(self, width):
        if width not in self._scenes:
            simulation = {"dt": self._program["dt"], "gravity": tuple(self._program["gravity"])}
            rigid = {"enable_collision": bool(self._program["contacts"]), "enable_neutral_collision": True}
            scene = Scene(bodies(self._program), simulation, rigid, width, friction=1.0)
            self._set_contact(scene.robot)
            self._scenes[width] = scene
        return self._scenes[width]

    def _set_contact(self, robot):
        """Set the contact's parameters so that its force is that of the law plus the share of other forces.

        The share is p A / (p A + (1 - p) W), for Genesis' impedance p, the inverse mass A along the normal, and the
        inverse mass W that Genesis regularises the contact with. With a friction coefficient of 1, the four edges of
        the friction pyramid push as one.
        """
        if not self._program["contacts"]:
            return
        law, share = self._program["contact"], self._program["backend"]["impedance"]
        bodies = [self._program["bodies"][i] for i in self._program["contacts"][0]["bodies"] if i >= 0]
        inverse_mass = sum(1.0 / body["mass"] for body in bodies)
        regularising = sum(float(geom.link.get_invweight()[0]) for geom in robot.geoms)
        impedance = share * regularising / ((1.0 - share) * inverse_mass + share * regularising)
        scale = impedance * inverse_mass / share
        time = 2.0 / (law["damping"] * scale) if law["damping"] else NEVER
        if time < 2.0 * self._program["dt"]:
            raise NotImplementedError("Genesis limits a contact's damping to its mass by the time step")
        ratio = 1.0 / (time * np.sqrt(law["stiffness"] * scale))
        for geom in robot.geoms:
            geom.set_sol_params(np.array([time, ratio, impedance, impedance, 1e-3, 0.5, 2.0]))

    def step(self, x, u):
        """Return the states after one step."""
        return self._scene(x.shape[1]).run(*_rows(x, u))[0].detach().numpy().T

    def pull(self, x, u, slope):
        """Return the derivatives of the sum of slope times the next states, by one backward pass."""
        by_q, by_v, by_force = self._scene(x.shape[1]).pull(*_rows(x, u), slope.T)
        return np.concatenate([by_q, by_v.T]), by_force[0].T


def _rows(x, u):
    """Return positions, velocities and the forces of one step, a row per environment."""
    return *(part.T for part in np.split(x, 2)), u.T[None]
