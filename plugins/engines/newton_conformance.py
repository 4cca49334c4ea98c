"""Newton's Featherstone solver in the conformance set: a Warp tape per step, run again before its backward pass."""

import importlib.metadata
import xml.etree.ElementTree as ElementTree

import numpy as np
import warp as wp
from free_bodies import in_world, without_motors

wp.config.quiet = True
import newton  # noqa: E402

STEP = 1e-6
"""Step of the differences of a change of coordinates."""


class Engine:
    """A model per case. Springs replace contacts and limits, and equalities, tendons and friction loss are missing."""

    versions = {name: importlib.metadata.version(name) for name in ("newton", "warp-lang")}
    tolerance = "float32"

    def __init__(self):
        self.differs, self._built = {}, {}

    def _model(self, case):
        if case.name in self._built:
            return self._built[case.name]
        root, arms = without_motors(case)
        if case.name != "offset_slide":
            self.differs[case.name] = (
                "contacts, limits and integrator are its own; no equalities, tendons, friction loss"
            )
        builder = newton.ModelBuilder()
        builder.add_mjcf(ElementTree.tostring(root, encoding="unicode"), skip_equality_constraints=True)
        model = builder.finalize(requires_grad=True)
        parts = model, newton.solvers.SolverFeatherstone(model, angular_damping=0.0), newton.CollisionPipeline(model)
        self._built[case.name] = arms, float(root.find("option").get("timestep")), parts
        return self._built[case.name]

    def _step(self, case, x, u):
        """Return the state after a step from Newton's (q, v), and a function for products with its derivative."""
        arms, dt, (model, solver, pipeline) = self._model(case)
        before, after, control = model.state(), model.state(), model.control()
        split = np.split(np.float32(x), [case.qpos.size])
        for array, values in zip((before.joint_q, before.joint_qd, control.joint_f), (*split, arms @ u), strict=True):
            array.assign(np.float32(values))
        newton.eval_fk(model, before.joint_q, before.joint_qd, before)
        contacts = pipeline.contacts()
        pipeline.collide(before, contacts)
        with wp.Tape() as tape:
            solver.step(before, after, control, contacts, dt)

        def pull(slope):
            tape.zero()
            seeds = [wp.array(np.float32(part)) for part in np.split(slope, [case.qpos.size])]
            tape.backward(grads=dict(zip((after.joint_q, after.joint_qd), seeds, strict=True)))
            by_state = [array.grad.numpy().astype(float) for array in (before.joint_q, before.joint_qd)]
            by_u = arms.T @ control.joint_f.grad.numpy()
            tape.zero()  # the solver's matrices, which all steps share
            return np.concatenate(by_state), by_u

        return np.concatenate([after.joint_q.numpy(), after.joint_qd.numpy()]).astype(float), pull

    def _path(self, case):
        self._model(case)  # raises what it does not have
        path = [_turned(case, np.concatenate([case.qpos, case.qvel]), True)]
        for u in case.controls:
            path.append(self._step(case, path[-1], u)[0])
        return path

    def rollout(self, case):
        """Return the cost of a case."""
        return self._cost(case, self._path(case)[-1])

    @staticmethod
    def _cost(case, x):
        return float(case.cost(*np.split(_turned(case, x, False), [case.qpos.size])))

    def gradient(self, case):
        """Return the derivatives by state and controls."""
        *path, end = self._path(case)
        slope, by_control = _differences(lambda x: self._cost(case, x), end), []
        for x, u in zip(path[::-1], case.controls[::-1], strict=True):
            slope, by_u = self._step(case, x, u)[1](slope)
            by_control.insert(0, by_u)
        start = np.concatenate([case.qpos, case.qvel])
        slope = _differences(lambda at: slope @ _turned(case, at, True), start)
        return {"qpos": slope[: case.qpos.size], "qvel": slope[case.qpos.size :], "controls": by_control}


def _differences(function, x):
    return np.array([(function(x + h) - function(x - h)) / (2 * STEP) for h in STEP * np.eye(len(x))])


def _turned(case, x, is_forward):
    """Return the state with quaternions (x, y, z, w) and angular velocities in the world, or back."""
    order = np.arange(case.qpos.size)
    for i in case.data["quaternions"]:
        order[i : i + 4] = np.roll(order[i : i + 4], -1 if is_forward else 1)
    q, v = np.split(x, [order.size])
    return np.concatenate([q[order], in_world(case, q if is_forward else q[order], v, 1 if is_forward else -1)])
