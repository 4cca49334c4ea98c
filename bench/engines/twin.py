"""Reads a scene's MJCF twin, for engines that build their models themselves."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from typing import Any

from bench.errors import Unsupported

KNOWN = {"option", "worldbody", "contact", "actuator", "tendon", "geom", "body", "joint", "inertial", "pair", "motor", "fixed"}
"""The elements of twins."""


def read(mjcf: str) -> dict[str, Any]:
    """Return a twin as numbers: gravity, bodies, ground, contacts, tendons and motors.

    - ``gravity``: ``(3,)`` [m/s^2].
    - ``bodies``: each with ``parent`` (an index, -1 for the world), ``joint`` (``slide`` or ``hinge``), ``axis``, ``damping``,
      ``mass``, ``com``, ``inertia`` (diagonal) and its sphere's ``radius`` and ``centre``, 0 without one. Body i has
      coordinate i of q.
    - ``has_ground``: whether there is the plane z = 0.
    - ``contacts``: pairs of bodies, -1 for the ground, each with ``friction``, 0 without.
    - ``motors``: the coordinate, or ``[tendon]`` as a list, that each control acts on.
    - ``tendons``: each with ``stiffness``, ``damping``, ``length`` and ``coefficients`` by coordinate.

    Raises :class:`Unsupported` for a twin with other elements, or a body with other than one slide or hinge.
    """
    root = ElementTree.fromstring(f"<mujoco>{mjcf}</mujoco>")
    if strange := sorted({node.tag for node in root.iter()} - KNOWN - {"mujoco"}):
        raise Unsupported(f"the twin has {', '.join(strange)}, which this engine's models do not have")
    bodies: list[dict[str, Any]] = []
    geoms, joints = {}, {}
    option = root.find("option")
    gravity = _numbers(option.get("gravity", "0 0 -9.81")) if option is not None else [0.0, 0.0, 0.0]
    world = root.find("worldbody")
    assert world is not None
    grounds = [geom for geom in world.findall("geom") if geom.get("type") == "plane"]
    geoms |= {geom.get("name"): -1 for geom in grounds}

    def add(node: ElementTree.Element, parent: int) -> None:
        own = node.findall("joint")
        if len(own) != 1 or own[0].get("type") not in ("slide", "hinge"):
            raise Unsupported("the twin has a body without exactly one slide or hinge")
        joint, inertial, geom = own[0], node.find("inertial"), node.find("geom")
        if geom is not None and geom.get("type") != "sphere":
            raise Unsupported(f"the twin has a {geom.get('type')}, and this engine's models have spheres and a ground")
        index = len(bodies)
        joints[joint.get("name")] = index
        radius = 0.0 if geom is None else float(geom.get("size", "0").split()[0])
        centre = [0.0, 0.0, 0.0] if geom is None else _numbers(geom.get("pos", "0 0 0"))
        mass = float(inertial.get("mass", "0")) if inertial is not None else float(geom.get("mass", "0")) if geom is not None else 0.0
        ball = 0.4 * mass * radius**2
        inertia = _numbers(inertial.get("diaginertia", "0 0 0")) if inertial is not None else [ball, ball, ball]
        com = _numbers(inertial.get("pos", "0 0 0")) if inertial is not None else centre
        bodies.append({
            "parent": parent, "joint": joint.get("type"), "axis": _numbers(joint.get("axis", "0 0 1")),
            "damping": float(joint.get("damping", "0")), "stiffness": float(joint.get("stiffness", "0")), "mass": mass,
            "com": com, "inertia": inertia, "radius": radius, "centre": centre,
        })  # fmt: skip
        if geom is not None:
            geoms[geom.get("name")] = index
        for inner in node.findall("body"):
            if inner.get("pos") is not None:
                raise Unsupported("the twin has a body with an offset")
            add(inner, index)

    for node in world.findall("body"):
        add(node, -1)
    tendons, ropes = [], {}
    for rope in root.findall("tendon/fixed"):
        coefficients = [0.0] * len(bodies)
        for part in rope.findall("joint"):
            coefficients[joints[part.get("joint")]] = float(part.get("coef", "1"))
        ropes[rope.get("name")] = len(tendons)
        tendons.append({
            "stiffness": float(rope.get("stiffness", "0")), "damping": float(rope.get("damping", "0")),
            "length": float(rope.get("springlength", "0")), "coefficients": coefficients,
        })  # fmt: skip
    contacts = [
        {
            "bodies": [geoms[pair.get("geom1")], geoms[pair.get("geom2")]],
            "friction": _numbers(pair.get("friction", "0"))[0] if pair.get("condim") != "1" else 0.0,
        }
        for pair in root.findall("contact/pair")
    ]
    motors = [
        [ropes[motor.get("tendon")]] if motor.get("tendon") else joints[motor.get("joint")]
        for motor in root.findall("actuator/motor")
    ]
    return {
        "gravity": gravity, "bodies": bodies, "has_ground": bool(grounds), "contacts": contacts, "tendons": tendons,
        "motors": motors,
    }  # fmt: skip


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]
