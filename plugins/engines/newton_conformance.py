"""Newton's Featherstone solver in the conformance set: a Warp tape per step, run again before its backward pass."""

import importlib.metadata
import xml.etree.ElementTree as ElementTree

import numpy as np
from free_bodies import SteppedEngine, without_motors
from newton_worlds import Worlds, newton


class Engine(SteppedEngine):
    """A model per case. Springs replace contacts and limits, and equalities, tendons and friction loss are missing."""

    versions = {name: importlib.metadata.version(name) for name in ("newton", "warp-lang")}
    tolerance = "float32"
    order_q = np.array([0, 1, 2, 4, 5, 6, 3])  # quaternions are (x, y, z, w)

    def build(self, case):
        """Return the world and the forces of its motors."""
        root, arms = without_motors(case)
        if case.name != "offset_slide":
            self.differs[case.name] = (
                "contacts, limits and integrator are its own; no equalities, tendons, friction loss"
            )
        builder = newton.ModelBuilder()
        builder.add_mjcf(ElementTree.tostring(root, encoding="unicode"), skip_equality_constraints=True)
        model, dt = builder.finalize(requires_grad=True), float(root.find("option").get("timestep"))
        solver = newton.solvers.SolverFeatherstone(model, angular_damping=0.0)
        return Worlds(model, solver, 1, case.qpos.size, dt, True), arms
