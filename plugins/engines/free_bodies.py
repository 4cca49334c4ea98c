"""Cases of the conformance set for engines with motors and angular velocities of their own."""

import xml.etree.ElementTree as ElementTree

import numpy as np


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


def in_world(case, q, v, sign=1):
    """Return v with angular velocities of free bodies in the world's frame, or with sign -1 in the bodies' frames again."""
    v = v.copy()
    for body, i in enumerate(case.data["quaternions"]):
        rates, axis = slice(6 * body + 3, 6 * body + 6), sign * q[i + 1 : i + 4]
        across = np.cross(axis, v[rates])
        v[rates] = v[rates] + 2 * (q[i] * across + np.cross(axis, across))
    return v
