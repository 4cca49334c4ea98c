"""Genesis in the conformance set: its rigid solver from the MJCF file, differentiated backward through all steps."""

import importlib.metadata

import genesis as gs
import numpy as np
import torch
from free_bodies import differences, in_world, without_motors
from genesis.utils.misc import qd_to_torch

gs.init(backend=gs.cpu, precision="64", logging_level="error")


class Engine:
    """A scene per case. Motors are forces on their joints."""

    versions = {name: importlib.metadata.version(name) for name in ("genesis-world", "torch")}
    tolerance = 1e-5

    def __init__(self):
        self.differs, self._built = {}, {}

    def _build(self, case):
        root, arms = without_motors(case)
        options = gs.options.SimOptions(dt=float(root.find("option").get("timestep")), requires_grad=True)
        scene = gs.Scene(sim_options=options, show_viewer=False)
        robot = scene.add_entity(gs.morphs.MJCF(file=root, default_armature=0.0))
        scene.build()
        return arms, scene, robot

    def _run(self, case):
        """Return the last state, the velocity and the forces as tensors, the motors' arms and the scene."""
        if case.name not in self._built:
            self._built[case.name] = self._build(case)
        arms, scene, robot = self._built[case.name]
        scene.reset()
        velocity = torch.tensor(in_world(case, case.qpos, case.qvel), requires_grad=True)
        forces = torch.tensor(case.controls @ arms.T, requires_grad=True)
        robot.set_qpos(torch.tensor(case.qpos), zero_velocity=False)
        robot.set_dofs_velocity(velocity)
        for force in forces:
            robot.control_dofs_force(force)
            scene.step()
        after = scene.rigid_solver.get_state()
        return torch.cat([after.qpos.ravel(), after.dofs_vel.ravel()]), velocity, forces, arms, scene

    def rollout(self, case):
        """Return the cost of a case."""
        return _cost(case, self._run(case)[0].detach().numpy())

    def gradient(self, case):
        """Return the derivatives by state and controls. Positions are no inputs of the tape, so theirs are read from the solver."""
        end, velocity, forces, arms, scene = self._run(case)
        slope = torch.tensor(differences(lambda x: _cost(case, x), end.detach().numpy()))
        by_v, by_force = (part.numpy() for part in torch.autograd.grad((slope * end).sum(), (velocity, forces)))
        by_q = qd_to_torch(scene.rigid_solver.rigid_info.qpos.grad, copy=True).numpy().ravel()
        start = np.concatenate([case.qpos, case.qvel])
        q, v = np.split(
            differences(lambda x: np.concatenate([by_q, by_v]) @ _turned(case, x, 1), start), [case.qpos.size]
        )
        return {"qpos": q, "qvel": v, "controls": by_force @ arms}


def _turned(case, x, sign):
    q, v = np.split(x, [case.qpos.size])
    return np.concatenate([q, in_world(case, q, v, sign)])


def _cost(case, x):
    return case.cost(*np.split(_turned(case, x, -1), [case.qpos.size]))
