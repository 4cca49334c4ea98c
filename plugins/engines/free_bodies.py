"""Cases of the conformance set by an engine's steps, for engines with motors and angular velocities of their own."""

import xml.etree.ElementTree as ElementTree

import numpy as np

TINY = 1e-30
"""Complex step, whose differences are exact to rounding."""


class SteppedEngine:
    """Steps of a model per case, and the adjoint through their derivatives.

    ``build(case)`` returns a model with ``step`` and ``jacobians`` or ``pull`` of columns, as :mod:`bench.engines.server`
    has it, and the forces of its motors. ``order_q`` and ``order_v`` are the places in a free body's MuJoCo coordinates of
    the engine's; ``in_world``: whether its angular velocities are in the world's frame.
    """

    order_q, order_v, in_world = np.arange(7), np.arange(6), True

    def __init__(self):
        self.differs, self._built = {}, {}

    def _path(self, case):
        """Return the engine's states along the rollout."""
        if case.name not in self._built:
            self._built[case.name] = self.build(case)
        model, arms = self._built[case.name]
        path = [self._state(case, case.qpos, case.qvel)]
        for control in case.controls:
            force = self._force(case, path[-1], arms @ control)
            path.append(model.step(path[-1][:, None], force[:, None])[:, 0])
        return path

    def _order(self, case):
        """Return the places in MuJoCo's states of the engine's."""
        order, n_q = np.arange(case.qpos.size + case.qvel.size), case.qpos.size
        for body, i in enumerate(case.data["quaternions"]):
            order[i - 3 : i + 4] = i - 3 + self.order_q
            order[n_q + 6 * body : n_q + 6 * body + 6] = n_q + 6 * body + self.order_v
        return order

    def _turned(self, case, q, v, sign=1):
        """Return velocities or forces in the engine's frames, or with sign -1 in MuJoCo's."""
        v = v + 0 * q[0]
        for body, i in enumerate(case.data["quaternions"] if self.in_world else ()):
            rates, axis = slice(6 * body + 3, 6 * body + 6), sign * q[i + 1 : i + 4]
            across = np.cross(axis, v[rates])
            v[rates] += 2 * (q[i] * across + np.cross(axis, across))
        return v

    def _state(self, case, q, v):
        """Return MuJoCo's positions and velocities, or forces, as the engine has them."""
        return np.concatenate([q, self._turned(case, q, v)])[self._order(case)]

    def _split(self, case, x):
        """Return MuJoCo's positions of one of the engine's states, and velocities in the engine's frames."""
        return np.split(x[np.argsort(self._order(case))], [case.qpos.size])

    def _force(self, case, x, force):
        """Return the engine's force at one of its states."""
        return self._state(case, self._split(case, x)[0], force)[case.qpos.size :]

    def _cost(self, case, x):
        q, v = self._split(case, x)
        return case.cost(q, self._turned(case, q, v, -1))

    def rollout(self, case):
        """Return the cost of a case."""
        return float(self._cost(case, self._path(case)[-1]))

    def gradient(self, case):
        """Return the derivatives by state and controls."""
        *path, end = self._path(case)
        slope, by_control, n_q = _slope(lambda x: self._cost(case, x), end), [], case.qpos.size
        for x, control in zip(path[::-1], case.controls[::-1], strict=True):
            slope, by_u = self._pulled(case, x, control, slope)
            by_control.insert(0, by_u)
        start = np.append(case.qpos, case.qvel)
        by_start = _slope(lambda start: slope @ self._state(case, *np.split(start, [n_q])), start)
        return {"qpos": by_start[:n_q], "qvel": by_start[n_q:], "controls": np.array(by_control)}

    def _pulled(self, case, x, control, slope):
        """Return the derivatives by state and control of the sum of slope times the next state."""
        (model, arms), inputs = self._built[case.name], np.append(x, control)

        def force(inputs):
            return self._force(case, inputs[: x.size], arms @ inputs[x.size :])

        at = x[:, None], force(inputs)[:, None]
        if hasattr(model, "pull"):
            by_x, by_force = (part[:, 0] for part in model.pull(*at, slope[:, None]))
        else:
            by_x, by_force = (slope @ part[..., 0] for part in model.jacobians(*at))
        through = _slope(lambda inputs: by_force @ force(inputs), inputs)
        return by_x + through[: x.size], through[x.size :]


def _slope(function, x):
    return np.array([function(x + step).imag for step in 1j * TINY * np.eye(len(x))]) / TINY


def without_motors(case):
    """Return the root of the case's MJCF without actuators, and the forces ``(n_v, n_u)`` of its motors per control."""
    root = ElementTree.parse(case.model).getroot()
    if root.find(".//joint[@type='ball']") is not None or root.find("actuator/position") is not None:
        raise NotImplementedError("ball joints and servos are not supported")
    if root.find("actuator/motor[@tendon]") is not None:
        raise NotImplementedError("motors of tendons are not supported")
    row, rows = 0, {}
    for joint in root.find("worldbody").iter():
        if joint.tag in ("joint", "freejoint"):
            rows[joint.get("name")] = row
            row += 6 if joint.tag == "freejoint" else 1
    arms = np.zeros((case.qvel.size, case.controls.shape[1]))
    for column, motor in enumerate(root.findall("actuator/motor")):
        gear = np.array(motor.get("gear", "1").split(), dtype=float)
        first = rows[motor.get("joint")]
        arms[first : first + gear.size, column] = gear
    root.remove(root.find("actuator"))
    return root, arms


def differing(root, reasons):
    """Return the reasons whose paths find an element in the MJCF, as text."""
    return "; ".join(dict.fromkeys(reason for path, reason in reasons.items() if root.find(f".//{path}") is not None))
