"""Worlds of a Newton model, stepped by a solver and differentiated by a tape per step."""

import numpy as np
import warp as wp

wp.config.quiet = True
import newton  # noqa: E402


class Worlds:
    """Equal worlds in joint coordinates: states ``(n_q + n_v, width)``, generalised forces ``(n_v, width)``."""

    has_joints = True

    def __init__(self, model, solver, width, n_q, dt, has_contacts):
        self._model, self._solver, self._width, self._n_q, self._dt = model, solver, width, n_q, dt
        self._before, self._after = model.state(), model.state()
        self._control = model.control()
        self._force = self._control.joint_f if self.has_joints else self._before.body_f
        self._pipeline = newton.CollisionPipeline(model) if has_contacts else None
        self._contacts = self._pipeline.contacts() if self._pipeline else None

    def _arrays(self, state):
        """Return the state's arrays of positions and of velocities."""
        return state.joint_q, state.joint_qd

    def _spread(self, values, array, identity=0.0):
        """Return values ``(n, width)`` as the array stores them; ``identity`` is the last number of its rotations."""
        return np.float32(values.T.reshape(-1))

    def _read(self, *arrays):
        return np.concatenate([array.numpy().reshape(self._width, -1).T for array in arrays]).astype(np.float64)

    def _run(self, x, u):
        """Set the states and forces of all worlds, and record one step."""
        inputs = (*self._arrays(self._before), self._force)
        for array, values in zip(inputs, (*np.split(x, [self._n_q]), u), strict=True):
            array.assign(self._spread(values, array, 1.0))
        if self._pipeline:
            if self.has_joints:
                newton.eval_fk(self._model, *inputs[:2], self._before)
            self._pipeline.collide(self._before, self._contacts)
        with wp.Tape() as tape:
            self._solver.step(self._before, self._after, self._control, self._contacts, self._dt)
        return tape

    def step(self, x, u):
        """Return the states after one step."""
        self._run(x, u)
        return self._read(*self._arrays(self._after))

    def pulls(self, x, u, slopes):
        """Return the derivatives by states and forces of the sum of each slope times the next states."""
        tape = self._run(x, u)
        return [self._back(tape, slope) for slope in slopes]

    def pull(self, x, u, slope):
        """Return the derivatives of the sum of slope times the next states."""
        return self.pulls(x, u, [slope])[0]

    def _back(self, tape, slope):
        tape.zero()
        after = zip(self._arrays(self._after), np.split(slope, [self._n_q]), strict=True)
        tape.backward(grads={array: wp.array(self._spread(part, array), dtype=array.dtype) for array, part in after})
        by_state = self._read(*(array.grad for array in self._arrays(self._before)))
        result = by_state, self._read(self._force.grad)
        tape.zero()  # the solver's matrices, which all steps share
        return result
