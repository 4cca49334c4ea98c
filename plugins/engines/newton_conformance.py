"""Newton's Featherstone solver in the conformance set: a Warp tape per step, run again before its backward pass."""

import importlib.metadata
import xml.etree.ElementTree as ElementTree

import numpy as np
from free_bodies import in_world, without_motors
from newton_worlds import Worlds, newton

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
        model, dt = builder.finalize(requires_grad=True), float(root.find("option").get("timestep"))
        solver = newton.solvers.SolverFeatherstone(model, angular_damping=0.0)
        self._built[case.name] = arms, Worlds(model, solver, 1, case.qpos.size, dt, True)
        return self._built[case.name]

    def _path(self, case):
        """Return Newton's (q, v) along the rollout, the forces, and the worlds."""
        arms, worlds = self._model(case)
        path, forces = [_turned(case, np.concatenate([case.qpos, case.qvel]), True)], case.controls @ arms.T
        for force in forces:
            path.append(worlds.step(path[-1][:, None], force[:, None])[:, 0])
        return path, forces, worlds

    def rollout(self, case):
        """Return the cost of a case."""
        return self._cost(case, self._path(case)[0][-1])

    @staticmethod
    def _cost(case, x):
        return float(case.cost(*np.split(_turned(case, x, False), [case.qpos.size])))

    def gradient(self, case):
        """Return the derivatives by state and controls."""
        (*path, end), forces, worlds = self._path(case)
        slope, by_force = _differences(lambda x: self._cost(case, x), end), []
        for x, force in zip(path[::-1], forces[::-1], strict=True):
            ((by_x, by_f),) = worlds.pulls(x[:, None], force[:, None], [slope[:, None]])
            slope = by_x[:, 0]
            by_force.insert(0, by_f[:, 0])
        start = np.concatenate([case.qpos, case.qvel])
        slope = _differences(lambda at: slope @ _turned(case, at, True), start)
        return {
            "qpos": slope[: case.qpos.size],
            "qvel": slope[case.qpos.size :],
            "controls": np.array(by_force) @ self._model(case)[0],
        }


def _differences(function, x):
    return np.array([(function(x + h) - function(x - h)) / (2 * STEP) for h in STEP * np.eye(len(x))])


def _turned(case, x, is_forward):
    """Return the state with quaternions (x, y, z, w) and angular velocities in the world, or back."""
    order = np.arange(case.qpos.size)
    for i in case.data["quaternions"]:
        order[i : i + 4] = np.roll(order[i : i + 4], -1 if is_forward else 1)
    q, v = np.split(x, [order.size])
    return np.concatenate([q[order], in_world(case, q if is_forward else q[order], v, 1 if is_forward else -1)])
