"""Genesis in the conformance set: its rigid solver from the MJCF file, differentiated backward through all steps."""

import importlib.metadata

import genesis as gs
import torch
from free_bodies import differing, without_motors
from genesis.utils.misc import qd_to_torch

gs.init(backend=gs.cpu, precision="64", logging_level="error")
DIFFERENT = {
    "geom[@condim='1']": "contacts have friction",
    "geom[@condim='4']": "no torsional friction",
    "geom[@condim='6']": "no rolling friction",
    "option[@cone='elliptic']": "no elliptic cones",
    "contact/pair": "no contact pairs",
    "body[@gravcomp]": "no fluids",
    "option[@integrator='RK4']": "the integrator is its own",
    "tendon/": "no tendons",
}
"""Elements that Genesis runs in another way than MuJoCo, or ignores."""


class Engine:
    """A scene per case, with MuJoCo's law of constraints. Motors are forces on their joints."""

    versions = {name: importlib.metadata.version(name) for name in ("genesis-world", "torch")}

    def __init__(self):
        self.differs, self._built = {}, {}

    def _build(self, case):
        root, arms = without_motors(case)
        self.differs[case.name] = differing(root, DIFFERENT)
        scene = gs.Scene(
            sim_options=gs.options.SimOptions(dt=float(root.find("option").get("timestep")), requires_grad=True),
            rigid_options=gs.options.RigidOptions(
                constraint_timeconst=0.02, iterations=100, tolerance=1e-14
            ),
            show_viewer=False,
        )  # fmt: skip
        robot = scene.add_entity(gs.morphs.MJCF(file=root, default_armature=0.0))
        scene.build()
        return arms, scene, robot

    def _run(self, case):
        """Return the cost and the inputs as tensors, the motors' arms and the scene."""
        if case.name not in self._built:
            self._built[case.name] = self._build(case)
        arms, scene, robot = self._built[case.name]
        scene.reset()
        velocity, forces = (torch.tensor(part, requires_grad=True) for part in (case.qvel, case.controls @ arms.T))
        robot.set_qpos(torch.tensor(case.qpos), zero_velocity=False)
        robot.set_dofs_velocity(velocity)
        for force in forces:
            robot.control_dofs_force(force)
            scene.step()
        after, weights = scene.rigid_solver.get_state(), case.data["weights"]
        by = (torch.tensor(weights[term], dtype=torch.float64) for term in ("qpos", "qvel"))
        cost = sum((weight * part).sum() for weight, part in zip(by, (after.qpos, after.dofs_vel), strict=True))
        return cost, (velocity, forces), arms, scene

    def rollout(self, case):
        """Return the cost of a case."""
        return float(self._run(case)[0].detach())

    def gradient(self, case):
        """Return the derivatives by state and controls. The tape lacks the positions, so the solver has theirs."""
        cost, inputs, arms, scene = self._run(case)
        by_v, by_force = torch.autograd.grad(cost, inputs)
        by_q = qd_to_torch(scene.rigid_solver.rigid_info.qpos.grad, copy=True)
        return {"qpos": by_q.numpy(), "qvel": by_v.numpy(), "controls": by_force.numpy() @ arms}
