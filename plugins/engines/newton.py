"""Newton's solvers on Warp: a world per column, a tape per step."""

import numpy as np
import warp as wp

wp.config.quiet = True
import newton  # noqa: E402

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


class _Batch:
    """Worlds of bodies on joints, stepped by the Featherstone solver."""

    has_joints = True

    def __init__(self, program, width):
        self._program, self._width, self._n = program, width, len(program["bodies"])
        axes = np.array([body["axis"] for body in program["bodies"]])
        self._axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        one, all_worlds = newton.ModelBuilder(up_axis="Z"), newton.ModelBuilder(up_axis="Z")
        law = program["contact"]
        shape = newton.ModelBuilder.ShapeConfig(
            density=0.0,
            ke=law.get("stiffness", 0.0),
            kd=law.get("damping", 0.0),
            kf=0.0,
            mu=0.0,
            gap=GAP,
            restitution=program["parameters"].get("restitution", 0.0),
        )
        self._add_bodies(one, shape)
        all_worlds.replicate(one, width)
        if program["has_ground"]:
            all_worlds.add_ground_plane(cfg=shape)
        self._model = all_worlds.finalize(requires_grad=program["backend"]["solver"] != "xpbd")
        self._model.set_gravity(tuple(program["gravity"]))
        self._solver = self._new_solver()
        self._before, self._after = self._model.state(), self._model.state()
        self._control = self._model.control()
        self._force = self._control.joint_f if self.has_joints else self._before.body_f
        self._pipeline = newton.CollisionPipeline(self._model) if program["contacts"] else None
        self._contacts = self._pipeline.contacts() if self._pipeline else None

    def _new_solver(self):
        return newton.solvers.SolverFeatherstone(self._model, angular_damping=0.0)

    def _add_bodies(self, builder, shape):
        links, chains = [], []
        touching = {body for contact in self._program["contacts"] for body in contact["bodies"]}
        for i, body in enumerate(self._program["bodies"]):
            inertia = wp.mat33(np.diag(body["inertia"]))
            links.append(
                builder.add_link(mass=body["mass"], com=wp.vec3(*body["com"]), inertia=inertia, lock_inertia=True)
            )
            if i in touching:
                pose = wp.transform(wp.vec3(*body["centre"]), wp.quat_identity())
                builder.add_shape_sphere(links[i], xform=pose, radius=body["radius"], cfg=shape)
            if not self.has_joints:
                continue
            parent = links[body["parent"]] if body["parent"] >= 0 else -1
            add = builder.add_joint_prismatic if body["joint"] == "slide" else builder.add_joint_revolute
            joint = add(
                parent, links[i], axis=wp.vec3(*body["axis"]), armature=0.0, target_ke=0.0, target_kd=0.0, friction=0.0
            )
            if parent < 0:
                chains.append([])
            chains[-1].append(joint)
        for chain in chains:
            builder.add_articulation(chain)

    def _arrays(self, state):
        """Return the state's arrays of positions and of velocities."""
        return state.joint_q, state.joint_qd

    def _spread(self, values, array, identity=0.0):
        """Return values ``(n, width)`` as the array stores them; ``identity`` is the last number of its rotations."""
        return np.float32(values.T.reshape(-1))

    def _read(self, *arrays):
        return np.concatenate([array.numpy().reshape(self._width, self._n).T for array in arrays]).astype(np.float64)

    def _run(self, x, u):
        """Set the states and forces of all worlds, and record one step."""
        inputs = (*self._arrays(self._before), self._force)
        for array, values in zip(inputs, (*np.split(x, 2), u), strict=True):
            array.assign(self._spread(values, array, 1.0))
        if self._pipeline:
            if self.has_joints:
                newton.eval_fk(self._model, *inputs[:2], self._before)
            self._pipeline.collide(self._before, self._contacts)
        with wp.Tape() as tape:
            self._solver.step(self._before, self._after, self._control, self._contacts, self._program["dt"])
        return tape

    def step(self, x, u):
        self._run(x, u)
        return self._read(*self._arrays(self._after))

    def jacobians(self, x, u):
        tape = self._run(x, u)
        slopes = [np.broadcast_to(row[:, None], x.shape) for row in np.eye(len(x))]
        return [np.stack(parts) for parts in zip(*(self._back(tape, slope) for slope in slopes), strict=True)]

    def _back(self, tape, slope):
        tape.zero()
        after = zip(self._arrays(self._after), np.split(slope, 2), strict=True)
        tape.backward(grads={array: wp.array(self._spread(part, array), dtype=array.dtype) for array, part in after})
        by_state = self._read(*(array.grad for array in self._arrays(self._before)))
        result = by_state, self._read(self._force.grad)
        tape.zero()
        return result


class _FreeBatch(_Batch):
    """Bodies without joints, each on a slide of the world: its coordinate is its position along the slide.

    The motion across the slide is dropped after every step, as the slide would prevent it.
    """

    has_joints = False

    def _new_solver(self):
        if self._program["backend"]["solver"] == "xpbd":
            return newton.solvers.SolverXPBD(self._model, enable_restitution=True)
        return newton.solvers.SolverSemiImplicit(self._model, angular_damping=0.0)

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
