"""Reads a scene's MJCF twin, for engines that build their models themselves."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from typing import Any

import numpy as np

from bench.errors import Unsupported

KNOWN = {
    "mujoco", "option", "worldbody", "contact", "actuator", "tendon", "geom", "body", "joint", "inertial", "pair", "motor",
    "fixed",
}  # fmt: skip
"""The elements of twins."""
JOINT = {"name", "type", "axis", "damping", "stiffness"}
"""The attributes of their joints."""


def read(mjcf: str) -> dict[str, Any]:
    """Return a twin as numbers: gravity, bodies, ground, contacts, tendons and motors.

    - ``gravity``: ``(3,)`` [m/s^2].
    - ``bodies``: each with ``parent`` (an index, -1 for the world), ``joint`` (``slide`` or ``hinge``), ``axis``, ``mass``,
      ``com``, ``inertia`` (diagonal) and its sphere's ``radius`` and ``centre``, 0 without one. Body i has coordinate i
      of q.
    - ``has_ground``: whether there is the plane z = 0.
    - ``contacts``: pairs of bodies, -1 for the ground, each with ``friction``, 0 without.
    - ``forces``: the generalised forces of motors, springs and dampers of joints and tendons, ``constant (n_q,)`` plus
      ``by_state (n_q, 2 n_q)`` times (q, v) plus ``by_control (n_q, m)`` times u.

    Raises :class:`Unsupported` for a twin with other elements, or a body with other than one slide or hinge.
    """
    root = ElementTree.fromstring(f"<mujoco>{mjcf}</mujoco>")
    if strange := sorted({node.tag for node in root.iter()} - KNOWN):
        raise Unsupported(f"the twin has {', '.join(strange)}, which this engine's models do not have")
    bodies: list[dict[str, Any]] = []
    geoms: dict[str | None, int] = {}
    joints: dict[str | None, int] = {}
    springs: list[tuple[float, float, float, dict[int, float]]] = []
    option = root.find("option")
    gravity = [0.0, 0.0, 0.0] if option is None else _numbers(option, "gravity", "0 0 -9.81")
    world = root.find("worldbody")
    assert world is not None
    grounds = [geom for geom in world.findall("geom") if geom.get("type") == "plane"]
    geoms |= {geom.get("name"): -1 for geom in grounds}

    def add(node: ElementTree.Element, parent: int) -> None:
        own = node.findall("joint")
        if len(own) != 1 or own[0].get("type") not in ("slide", "hinge"):
            raise Unsupported("the twin has a body without exactly one slide or hinge")
        joint, inertial, geom = own[0], node.find("inertial"), node.find("geom")
        if strange := sorted(set(joint.keys()) - JOINT):
            raise Unsupported(f"the twin has a joint with {', '.join(strange)}, which this engine's models do not have")
        if geom is not None and geom.get("type") != "sphere":
            raise Unsupported(f"the twin has a {geom.get('type')}, and this engine's models have spheres and a ground")
        index = len(bodies)
        joints[joint.get("name")] = index
        springs.append((float(joint.get("stiffness", "0")), float(joint.get("damping", "0")), 0.0, {index: 1.0}))
        radius, centre = _numbers(geom, "size", "0")[0], _numbers(geom, "pos", "0 0 0")
        mass = _numbers(geom if inertial is None else inertial, "mass", "0")[0]
        com, inertia = centre, [0.4 * mass * radius**2] * 3
        if inertial is not None:
            com, inertia = _numbers(inertial, "pos", "0 0 0"), _numbers(inertial, "diaginertia", "0 0 0")
        bodies.append({
            "parent": parent, "joint": joint.get("type"), "axis": _numbers(joint, "axis", "0 0 1"),
            "mass": mass, "com": com, "inertia": inertia, "radius": radius, "centre": centre,
        })  # fmt: skip
        if geom is not None:
            geoms[geom.get("name")] = index
        for inner in node.findall("body"):
            if inner.get("pos") is not None:
                raise Unsupported("the twin has a body with an offset")
            add(inner, index)

    for node in world.findall("body"):
        add(node, -1)
    ropes: dict[str | None, dict[int, float]] = {}
    for rope in root.findall("tendon/fixed"):
        ropes[rope.get("name")] = {joints[p.get("joint")]: float(p.get("coef", "1")) for p in rope.findall("joint")}
        stiffness, damping, length = (float(rope.get(name, "0")) for name in ("stiffness", "damping", "springlength"))
        springs.append((stiffness, damping, length, ropes[rope.get("name")]))
    contacts = [
        {
            "bodies": [geoms[pair.get("geom1")], geoms[pair.get("geom2")]],
            "friction": _numbers(pair, "friction", "0")[0] if pair.get("condim") != "1" else 0.0,
        }
        for pair in root.findall("contact/pair")
    ]
    motors = [
        {joints[motor.get("joint")]: 1.0} if motor.get("joint") else ropes[motor.get("tendon")]
        for motor in root.findall("actuator/motor")
    ]
    return {
        "gravity": gravity, "bodies": bodies, "has_ground": bool(grounds), "contacts": contacts,
        "forces": _forces(len(bodies), springs, motors),
    }  # fmt: skip


def _forces(
    n: int, springs: list[tuple[float, float, float, dict[int, float]]], motors: list[dict[int, float]]
) -> dict[str, Any]:
    by_control = [[motor.get(i, 0.0) for motor in motors] for i in range(n)]
    arms = np.array([[arm.get(i, 0.0) for i in range(n)] for *_, arm in springs])
    stiffness, damping, length = np.array([spring[:3] for spring in springs]).T
    by_state = -np.hstack([(arms.T * factor) @ arms for factor in (stiffness, damping)])
    return {"constant": ((stiffness * length) @ arms).tolist(), "by_state": by_state.tolist(), "by_control": by_control}


def _numbers(node: ElementTree.Element | None, name: str, default: str) -> list[float]:
    """Return an attribute's numbers, or the default's where it or the element is missing."""
    return [float(word) for word in (default if node is None else node.get(name, default)).split()]
