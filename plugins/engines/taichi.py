"""A Taichi kernel of spheres on slides with spring contacts, stepped by semi-implicit Euler."""

import numpy as np
import taichi as ti

ti.init(arch=ti.cpu, default_fp=ti.f64, log_level=ti.ERROR, offline_cache=False)


class Model:
    """A twin as a kernel, with fields for each width."""

    takes_forces = True
    widths = (1, 64, 1024, 32768)

    def __init__(self, program):
        bodies, self._fields = program["bodies"], {}
        n = len(bodies)
        dt, stiffness, gravity = program["dt"], program["contact"].get("stiffness", 0.0), ti.Vector(program["gravity"])
        masses = [body["mass"] for body in bodies]
        axes = [ti.Vector(list(np.array(body["axis"]) / np.linalg.norm(body["axis"]))) for body in bodies]
        centres = [ti.Vector(body["centre"]) for body in bodies]
        radii = [body["radius"] for body in bodies]
        pairs = [sorted(contact["bodies"]) for contact in program["contacts"]]  # the ground, -1, comes first
        up = ti.Vector([0.0, 0.0, 1.0])

        @ti.kernel
        def kernel(x: ti.template(), u: ti.template(), y: ti.template(), width: ti.i32):
            for c in range(width):
                force = ti.Vector([0.0] * n)
                for i in ti.static(range(n)):
                    force[i] = u[i, c] + masses[i] * axes[i].dot(gravity)
                for p in ti.static(range(len(pairs))):
                    i, j = ti.static(*pairs[p])
                    if ti.static(i < 0):
                        gap = (centres[j] + axes[j] * x[j, c]).dot(up) - radii[j]
                        force[j] += stiffness * ti.max(-gap, 0.0) * axes[j].dot(up)
                    else:
                        away = centres[j] + axes[j] * x[j, c] - centres[i] - axes[i] * x[i, c]
                        normal = away / away.norm()
                        push = stiffness * ti.max(radii[i] + radii[j] - away.norm(), 0.0) * normal
                        force[i] -= push.dot(axes[i])
                        force[j] += push.dot(axes[j])
                for i in ti.static(range(n)):
                    v = x[n + i, c] + dt * force[i] / masses[i]
                    y[n + i, c] = v
                    y[i, c] = x[i, c] + dt * v

        self._kernel, self._n = kernel, n

    def _run(self, x, u):
        width = x.shape[1]
        if width not in self._fields:
            shapes = [(2 * self._n, width), (self._n, width), (2 * self._n, width)]
            self._fields[width] = [ti.field(ti.f64, shape, needs_grad=True) for shape in shapes]
        fields = self._fields[width]
        fields[0].from_numpy(x)
        fields[1].from_numpy(u)
        self._kernel(*fields, width)
        return fields

    def step(self, x, u):
        """Return the states after one step."""
        return self._run(x, u)[2].to_numpy()

    def pull(self, x, u, slope):
        """Return the derivatives of the sum of slope times the next states."""
        before, force, after = self._run(x, u)
        before.grad.fill(0.0)
        force.grad.fill(0.0)
        after.grad.from_numpy(slope)
        self._kernel.grad(before, force, after, x.shape[1])
        return before.grad.to_numpy(), force.grad.to_numpy()
