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
    world = root.find("worldbody")
    assert world is not None
    nodes, parents = list(world.iter("body")), {inner: outer for outer in world.iter() for inner in outer}
    option, grounds = root.find("option"), [geom for geom in world.findall("geom") if geom.get("type") == "plane"]
    geoms = {geom.get("name"): -1 for geom in grounds}
    joints: dict[str | None, int] = {}
    bodies: list[dict[str, Any]] = []
    springs: list[tuple[float, float, float, dict[int, float]]] = []
    for i, node in enumerate(nodes):
        joint, body = _body(node)
        bodies.append({"parent": nodes.index(parents[node]) if parents[node] in nodes else -1, **body})
        if bodies[i]["parent"] >= 0 and node.get("pos") is not None:
            raise Unsupported("the twin has a body with an offset")
        joints[joint.get("name")] = i
        geoms |= {geom.get("name"): i for geom in node.findall("geom")[:1]}
        springs.append((float(joint.get("stiffness", "0")), float(joint.get("damping", "0")), 0.0, {i: 1.0}))
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
        "gravity": [0.0, 0.0, 0.0] if option is None else _numbers(option, "gravity", "0 0 -9.81"),
        "bodies": bodies, "has_ground": bool(grounds), "contacts": contacts,
        "forces": _forces(len(bodies), springs, motors),
    }  # fmt: skip


def _body(node: ElementTree.Element) -> tuple[ElementTree.Element, dict[str, Any]]:
    """Return the joint of a body, and the body's own numbers; raises :class:`Unsupported` for other elements."""
    joints, inertial, geom = node.findall("joint"), node.find("inertial"), node.find("geom")
    if len(joints) != 1 or joints[0].get("type") not in ("slide", "hinge"):
        raise Unsupported("the twin has a body without exactly one slide or hinge")
    joint = joints[0]
    # the attributes of twins' joints
    if strange := sorted(set(joint.keys()) - {"name", "type", "axis", "damping", "stiffness"}):
        raise Unsupported(f"the twin has a joint with {', '.join(strange)}, which this engine's models do not have")
    if geom is not None and geom.get("type") != "sphere":
        raise Unsupported(f"the twin has a {geom.get('type')}, and this engine's models have spheres and a ground")
    radius, centre = _numbers(geom, "size", "0")[0], _numbers(geom, "pos", "0 0 0")
    mass = _numbers(geom if inertial is None else inertial, "mass", "0")[0]
    com, inertia = centre, [0.4 * mass * radius**2] * 3
    if inertial is not None:
        com, inertia = _numbers(inertial, "pos", "0 0 0"), _numbers(inertial, "diaginertia", "0 0 0")
    return joint, {
        "joint": joint.get("type"), "axis": _numbers(joint, "axis", "0 0 1"), "mass": mass, "com": com,
        "inertia": inertia, "radius": radius, "centre": centre,
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
