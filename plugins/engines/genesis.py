"""Genesis' rigid solver, all columns together, differentiated backward a step at a time."""

import xml.etree.ElementTree as ElementTree

import genesis as gs
import numpy as np
import torch
from genesis.utils.misc import qd_to_torch

gs.init(backend=gs.cpu, precision="64", logging_level="error")

NEVER = 1e9
"""Time constant [s] of a contact without damping."""


class Model:
    """A twin as a scene of parallel environments, one scene per width."""

    takes_forces = True
    widths = (64, 1024)

    def __init__(self, program):
        self._program, self._scenes, self._n = program, {}, len(program["bodies"])
        self.device = str(gs.device)

    def _scene(self, width):
        if width not in self._scenes:
            dt, gravity = self._program["dt"], tuple(self._program["gravity"])
            scene = gs.Scene(
                sim_options=gs.options.SimOptions(dt=dt, gravity=gravity, requires_grad=True),
                rigid_options=gs.options.RigidOptions(
                    enable_collision=bool(self._program["contacts"]), enable_neutral_collision=True
                ),
                show_viewer=False,
            )
            robot = scene.add_entity(
                gs.morphs.MJCF(file=self._mjcf(), default_armature=0.0), material=gs.materials.Rigid(friction=1.0)
            )
            scene.build(n_envs=width)
            self._set_contact(robot)
            self._scenes[width] = scene, robot
        return self._scenes[width]

    def _mjcf(self):
        """Return the bodies, with shapes where they touch."""
        root = ElementTree.Element("mujoco")
        world = ElementTree.SubElement(root, "worldbody")
        touching = {body for contact in self._program["contacts"] for body in contact["bodies"]}
        if -1 in touching:
            ElementTree.SubElement(world, "geom", type="plane", size="1 1 1")
        nodes = []
        for i, body in enumerate(self._program["bodies"]):
            nodes.append(ElementTree.SubElement(nodes[body["parent"]] if body["parent"] >= 0 else world, "body"))
            ElementTree.SubElement(nodes[i], "joint", type=body["joint"], axis=_words(body["axis"]))
            place = {"pos": _words(body["com"]), "mass": str(body["mass"]), "diaginertia": _words(body["inertia"])}
            ElementTree.SubElement(nodes[i], "inertial", place)
            if i in touching:
                shape = {"type": "sphere", "size": str(body["radius"]), "pos": _words(body["centre"])}
                ElementTree.SubElement(nodes[i], "geom", shape)
        return root

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

    def _run(self, x, u, slopes):
        """Return the states after one step, as a tensor, with its inputs velocity and force, and the scene."""
        scene, robot = self._scene(x.shape[1])
        scene.reset()
        position, velocity, force = (torch.as_tensor(part.T.copy()) for part in (x[: self._n], x[self._n :], u))
        for part in (velocity, force):
            part.requires_grad_(slopes)
        robot.set_qpos(position, zero_velocity=False)
        robot.set_dofs_velocity(velocity)
        robot.control_dofs_force(force)
        scene.step()
        after = scene.rigid_solver.get_state()
        return torch.cat([after.qpos, after.dofs_vel], dim=1), velocity, force, scene

    def step(self, x, u):
        """Return the states after one step."""
        return self._run(x, u, False)[0].detach().numpy().T

    def pull(self, x, u, slope):
        """Return the derivatives of the sum of slope times the next states, by one backward pass.

        Genesis' tape does not have a joint's position as an input, so its derivative is read from the solver.
        """
        after, velocity, force, scene = self._run(x, u, True)
        by_velocity, by_force = torch.autograd.grad((after * torch.as_tensor(slope.T.copy())).sum(), (velocity, force))
        by_position = qd_to_torch(scene.rigid_solver.rigid_info.qpos.grad, copy=True)
        return np.concatenate([by_position.numpy(), by_velocity.numpy().T]), by_force.numpy().T


def _words(values):
    return " ".join(map(str, values))
