"""A Genesis scene of one MJCF file, differentiated backward through its steps."""

import genesis as gs
import numpy as np
import torch
from genesis.utils.misc import qd_to_torch

gs.init(backend=gs.cpu, precision="64", logging_level="error")


class Scene:
    """States and forces are arrays as Genesis has them: a row per environment, if it has several."""

    def __init__(self, root, simulation, rigid, n_envs=0, **material):
        self._scene = gs.Scene(
            sim_options=gs.options.SimOptions(requires_grad=True, **simulation),
            rigid_options=gs.options.RigidOptions(**rigid),
            show_viewer=False,
        )
        morph = gs.morphs.MJCF(file=root, default_armature=0.0)
        self.robot = self._scene.add_entity(morph, material=gs.materials.Rigid(**material))
        self._scene.build(n_envs=n_envs)

    def run(self, q, v, forces):
        """Return the last positions and velocities in one tensor, and the tensors of the velocities and forces given."""
        self._scene.reset()
        # Genesis' backward pass takes arrays of any other order for contiguous ones
        inputs = [torch.tensor(np.ascontiguousarray(part), requires_grad=True) for part in (v, forces)]
        self.robot.set_qpos(torch.tensor(q), zero_velocity=False)
        self.robot.set_dofs_velocity(inputs[0])
        for force in inputs[1]:
            self.robot.control_dofs_force(force)
            self._scene.step()
        after = self._scene.rigid_solver.get_state()
        return torch.cat([after.qpos, after.dofs_vel], dim=-1), inputs

    def pull(self, q, v, forces, slope):
        """Return the derivatives of the sum of slope times the last state by positions, velocities and forces.

        Genesis' tape does not have the positions as an input, so their derivative is read from the solver.
        """
        after, inputs = self.run(q, v, forces)
        by_v, by_force = torch.autograd.grad((after * torch.tensor(slope)).sum(), inputs)
        by_q = qd_to_torch(self._scene.rigid_solver.rigid_info.qpos.grad, copy=True)
        return by_q.numpy(), by_v.numpy(), by_force.numpy()
