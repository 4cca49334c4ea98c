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

    def pull(self, x, u, slope):
        """Return the derivatives of the sum of slope times the next states, by one backward pass."""
        return self._batch(x).pull(x, u, slope)

    def _batch(self, x):
        width = x.shape[1]
        if width not in self._batches:
            kind = _Batch if self._program["backend"]["solver"] == "featherstone" else _FreeBatch
            self._batches[width] = kind(self._program, width)
        return self._batches[width]


class _Batch:
    def __init__(self, program, width):
        self._program, self._width, self._n = program, width, len(program["bodies"])
        one, all_worlds = self._builder(), self._builder()
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
        self._model.set_gravity(tuple(self._program["gravity"]))
        self._solver = self._new_solver()
        self._before, self._after = self._model.state(), self._model.state()
        self._control = self._model.control()
        self._pipeline = newton.CollisionPipeline(self._model) if program["contacts"] else None
        self._contacts = self._pipeline.contacts() if self._pipeline else None

    def _new_solver(self):
        return newton.solvers.SolverFeatherstone(self._model, angular_damping=0.0)

    def _builder(self):
        return newton.ModelBuilder(up_axis="Z")

    def _add_bodies(self, builder, shape):
        links, shapes, chains = [], {}, []
        touching = {body for contact in self._program["contacts"] for body in contact["bodies"]}
        for i, body in enumerate(self._program["bodies"]):
            inertia = wp.mat33(np.diag(body["inertia"]))
            links.append(
                builder.add_link(mass=body["mass"], com=wp.vec3(*body["com"]), inertia=inertia, lock_inertia=True)
            )
            parent = links[body["parent"]] if body["parent"] >= 0 else -1
            add = builder.add_joint_prismatic if body["joint"] == "slide" else builder.add_joint_revolute
            joint = add(
                parent, links[i], axis=wp.vec3(*body["axis"]), armature=0.0, target_ke=0.0, target_kd=0.0, friction=0.0
            )
            if parent < 0:
                chains.append([])
            chains[-1].append(joint)
            if i in touching:
                pose = wp.transform(wp.vec3(*body["centre"]), wp.quat_identity())
                shapes[i] = builder.add_shape_sphere(links[i], xform=pose, radius=body["radius"], cfg=shape)
        for chain in chains:
            builder.add_articulation(chain)

    def _run(self, x, u):
        """Set the states and controls of all worlds, and record one step."""
        n = self._n
        self._before.joint_q.assign(np.float32(x[:n].T.reshape(-1)))
        self._before.joint_qd.assign(np.float32(x[n:].T.reshape(-1)))
        self._control.joint_f.assign(np.float32(u.T.reshape(-1)))
        if self._pipeline:
            newton.eval_fk(self._model, self._before.joint_q, self._before.joint_qd, self._before)
            self._pipeline.collide(self._before, self._contacts)
        with wp.Tape() as tape:
            self._solver.step(self._before, self._after, self._control, self._contacts, self._program["dt"])
        return tape

    def step(self, x, u):
        self._run(x, u)
        return self._read(self._after.joint_q, self._after.joint_qd)

    def _read(self, *arrays):
        return np.concatenate([array.numpy().reshape(self._width, self._n).T for array in arrays]).astype(np.float64)

    def jacobians(self, x, u):
        n, tape = self._n, self._run(x, u)
        a, b = np.empty((2 * n, 2 * n, self._width)), np.empty((2 * n, n, self._width))
        for i in range(2 * n):
            tape.zero()
            slope = np.zeros((2 * n, self._width))
            slope[i] = 1.0
            a[i], b[i] = self._back(tape, slope)
        tape.zero()
        return a, b

    def pull(self, x, u, slope):
        tape = self._run(x, u)
        tape.zero()
        result = self._back(tape, slope)
        tape.zero()
        return result

    def _back(self, tape, slope):
        seeds = [wp.array(np.float32(slope[rows].T.reshape(-1))) for rows in np.split(np.arange(2 * self._n), 2)]
        tape.backward(grads={self._after.joint_q: seeds[0], self._after.joint_qd: seeds[1]})
        by_state = self._read(self._before.joint_q.grad, self._before.joint_qd.grad)
        return by_state, self._read(self._control.joint_f.grad)


class _FreeBatch(_Batch):
    """Bodies without joints, each on a slide of the world: its coordinate is its position along the slide.

    The motion across the slide is dropped after every step, as the slide would prevent it.
    """

    def _new_solver(self):
        if self._program["backend"]["solver"] == "xpbd":
            return newton.solvers.SolverXPBD(self._model, enable_restitution=True)
        return newton.solvers.SolverSemiImplicit(self._model, angular_damping=0.0)

    def _add_bodies(self, builder, shape):
        bodies = self._program["bodies"]
        touching = {body for contact in self._program["contacts"] for body in contact["bodies"]}
        for i, body in enumerate(bodies):
            inertia = wp.mat33(np.diag(body["inertia"]))
            link = builder.add_link(mass=body["mass"], com=wp.vec3(*body["com"]), inertia=inertia, lock_inertia=True)
            if i in touching:
                pose = wp.transform(wp.vec3(*body["centre"]), wp.quat_identity())
                builder.add_shape_sphere(link, xform=pose, radius=body["radius"], cfg=shape)
        axes = np.array([body["axis"] for body in bodies])
        self._axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)

    def _along(self, values, size):
        """Return vectors of length ``size`` per body, whose first three components are the values along the slides."""
        result = np.zeros((self._width, self._n, size), dtype=np.float32)
        result[..., :3] = values.T[..., None] * self._axes
        return result.reshape(-1, size)

    def _read(self, *arrays):
        parts = [array.numpy().reshape(self._width, self._n, -1)[..., :3] for array in arrays]
        return np.concatenate([np.einsum("wnk,nk->nw", part, self._axes) for part in parts]).astype(np.float64)

    def _run(self, x, u):
        q, v = np.split(x, 2)
        poses = self._along(q, 7)
        poses[:, 6] = 1.0  # no rotation
        self._before.body_q.assign(poses)
        self._before.body_qd.assign(self._along(v, 6))
        self._before.body_f.assign(self._along(u, 6))
        if self._pipeline:
            self._pipeline.collide(self._before, self._contacts)
        with wp.Tape() as tape:
            self._solver.step(self._before, self._after, None, self._contacts, self._program["dt"])
        return tape

    def step(self, x, u):
        self._run(x, u)
        return self._read(self._after.body_q, self._after.body_qd)

    def _back(self, tape, slope):
        q, v = np.split(slope, 2)
        seeds = {
            after: wp.array(self._along(part, size), dtype=after.dtype)
            for after, part, size in ((self._after.body_q, q, 7), (self._after.body_qd, v, 6))
        }
        tape.backward(grads=seeds)
        by_state = self._read(self._before.body_q.grad, self._before.body_qd.grad)
        return by_state, self._read(self._before.body_f.grad)
