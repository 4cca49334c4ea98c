"""Newton's solvers on Warp: a world per column, a tape per step."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import warp as wp
from newton_worlds import Worlds, newton
from twin_bodies import bodies

GAP = 10.0
"""Distance [m] up to which contacts are generated. The solver's forces depend on the distance itself."""


class Model:
    """A twin as a batch of worlds, one model per width."""

    takes_forces = True
    widths = (1, 64, 512)

    def __init__(self, program):
        self._program, self._batches = program, {}
        self.device = str(wp.get_device())
        self.settings = {"deterministic": getattr(wp.config, "deterministic", "not an option")}

    def step(self, x, u):
        """Return the states after one step."""
        return self._batch(x).step(x, u)

    def jacobians(self, x, u):
        """Return the derivatives of one step, by one backward pass per component of the state."""
        return self._batch(x).jacobians(x, u)

    def _batch(self, x):
        width = x.shape[1]
        if width not in self._batches:
            kind = _Batch if self._program["backend"]["solver"] == "featherstone" else _FreeBatch
            self._batches[width] = kind(self._program, width)
        return self._batches[width]


class _Batch(Worlds):
    """Bodies on joints, stepped by the Featherstone solver."""

    def __init__(self, program, width):
        self._program, self._n = program, len(program["bodies"])
        axes = np.array([body["axis"] for body in program["bodies"]])
        self._axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        one, all_worlds = newton.ModelBuilder(up_axis="Z"), newton.ModelBuilder(up_axis="Z")
        law = program["contact"]
        one.default_shape_cfg = newton.ModelBuilder.ShapeConfig(
            density=0.0,
            ke=law.get("stiffness", 0.0),
            kd=law.get("damping", 0.0),
            kf=0.0,
            mu=0.0,
            gap=GAP,
            restitution=program["parameters"].get("restitution", 0.0),
        )
        root = bodies(program)
        for joint in root.iter("joint") if not self.has_joints else ():
            joint.attrib = {"type": "free"}
        one.add_mjcf(ElementTree.tostring(root, encoding="unicode"))
        all_worlds.replicate(one, width)
        model = all_worlds.finalize(requires_grad=program["backend"]["solver"] != "xpbd")
        model.set_gravity(tuple(program["gravity"]))
        super().__init__(model, self._new_solver(model), width, self._n, program["dt"], bool(program["contacts"]))

    def _new_solver(self, model):
        return newton.solvers.SolverFeatherstone(model, angular_damping=0.0)

    def jacobians(self, x, u):
        slopes = [np.broadcast_to(row[:, None], x.shape) for row in np.eye(len(x))]
        return [np.stack(parts) for parts in zip(*self.pulls(x, u, slopes), strict=True)]


class _FreeBatch(_Batch):
    """Bodies without joints, each on a slide of the world: its coordinate is its position along the slide.

    The motion across the slide is dropped after every step, as the slide would prevent it.
    """

    has_joints = False

    def _new_solver(self, model):
        if self._program["backend"]["solver"] == "xpbd":
            return newton.solvers.SolverXPBD(model, enable_restitution=True)
        return newton.solvers.SolverSemiImplicit(model, angular_damping=0.0)

    def _arrays(self, state):
        return state.body_q, state.body_qd

    def _spread(self, values, array, identity=0.0):
        result = np.zeros((self._width, self._n, array.numpy().shape[-1]), dtype=np.float32)
        result[..., :3] = values.T[..., None] * self._axes
        result[..., 6:] = identity  # only poses have a seventh number
        return result.reshape(-1, result.shape[-1])

    def _read(self, *arrays):
        parts = [array.numpy().reshape(self._width, self._n, -1)[..., :3] for array in arrays]
        return np.concatenate([np.einsum("wnk,nk->nw", part, self._axes) for part in parts]).astype(np.float64)
