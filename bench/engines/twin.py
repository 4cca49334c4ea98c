"""Reads a scene's MJCF twin, for engines that build their models themselves."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from typing import Any

import numpy as np

from bench.errors import Unsupported

KNOWN = {
    "mujoco",
    "option",
    "worldbody",
    "contact",
    "actuator",
    "tendon",
    "geom",
    "body",
    "joint",
    "inertial",
    "pair",
    "motor",
    "fixed",
}
"""The elements of twins."""
JOINT = {"name", "type", "axis", "damping", "stiffness"}
"""The attributes of twins' joints."""


def read(mjcf: str) -> dict[str, Any]:
    """Return a twin as numbers: gravity, bodies, ground, contacts, tendons and motors.

    - ``gravity``: ``(3,)`` [m/s^2].
    - ``bodies``: each with ``parent`` (an index, -1 for the world), ``joint`` (``slide`` or ``hinge``), ``axis``, ``mass``,
      ``com``, ``inertia`` (diagonal) and its sphere's ``radius`` and ``centre``, 0 without one. Body i has coordinate i
      of q.
    - ``has_ground``: whether there is a plane, and ``is_level``: whether it is z = 0.
    - ``contacts``: pairs of bodies, -1 for the ground, each with ``friction``, 0 without.
    - ``forces``: the generalised forces of motors, springs and dampers of joints and tendons, ``constant (n_q,)`` plus
      ``by_state (n_q, 2 n_q)`` times (q, v) plus ``by_control (n_q, m)`` times u.

    Raises :class:`Unsupported` for a twin with other elements, or a body with other than one slide or hinge.
    """
    import mujoco

    text = f'<mujoco><option gravity="0 0 0"/>{mjcf}</mujoco>'
    root = ElementTree.fromstring(text)
    strange = {node.tag for node in root.iter()} - KNOWN
    strange |= {f"joint with {name}" for joint in root.iterfind(".//body/joint") for name in set(joint.keys()) - JOINT}
    if strange:
        raise Unsupported(f"the twin has {', '.join(sorted(strange))}, which this engine's models do not have")
    model, kinds = mujoco.MjModel.from_xml_string(text), mujoco.mjtGeom
    moving, planes = slice(1, None), model.geom_type == kinds.mjGEOM_PLANE
    joints = {int(mujoco.mjtJoint.mjJNT_SLIDE): "slide", int(mujoco.mjtJoint.mjJNT_HINGE): "hinge"}
    refusals = {
        "a body without exactly one slide or hinge": (model.body_jntnum[moving] != 1).any()
        or {*model.jnt_type} - {*joints},
        "a body with an offset": model.body_pos.any(),
        "shapes other than a sphere per body and a ground": (model.body_geomnum[moving] > 1).any()
        or (model.geom_type[~planes] != kinds.mjGEOM_SPHERE).any(),
    }
    for reason, is_so in refusals.items():
        if is_so:
            raise Unsupported(f"the twin has {reason}")
    n, shapes = (
        model.nv,
        dict(zip(model.geom_bodyid, zip(model.geom_size[:, 0], model.geom_pos, strict=True), strict=True)),
    )
    nothing = 0.0, np.zeros(3)
    return {
        "gravity": model.opt.gravity.tolist(),
        "has_ground": bool(planes.any()),
        "is_level": not np.any([model.geom_pos[planes, 2], *model.geom_quat[planes, 1:3].T]),
        "forces": _forces(mujoco, model),
        "bodies": [
            {
                "parent": int(model.body_parentid[i + 1]) - 1,
                "joint": joints[model.jnt_type[i]],
                "axis": model.jnt_axis[i].tolist(),
                "mass": float(model.body_mass[i + 1]),
                "com": model.body_ipos[i + 1].tolist(),
                "inertia": model.body_inertia[i + 1].tolist(),
                "radius": float(shapes.get(i + 1, nothing)[0]),
                "centre": shapes.get(i + 1, nothing)[1].tolist(),
            }
            for i in range(n)
        ],
        "contacts": [
            {"bodies": [int(model.geom_bodyid[g]) - 1 for g in pair], "friction": float(friction[0] * (dim > 1))}
            for *pair, friction, dim in zip(
                model.pair_geom1, model.pair_geom2, model.pair_friction, model.pair_dim, strict=True
            )
        ],
    }


def _forces(mujoco: Any, model: Any) -> dict[str, Any]:
    """Return the generalised forces, which are linear in the state and the controls."""
    data, n = mujoco.MjData(model), model.nv

    def force(inputs: np.ndarray) -> Any:
        data.qpos, data.qvel, data.ctrl = np.split(inputs, [n, 2 * n])
        mujoco.mj_forward(model, data)
        return data.qfrc_passive + data.qfrc_actuator

    constant = force(np.zeros(2 * n + model.nu))
    slope = np.transpose([force(unit) - constant for unit in np.eye(2 * n + model.nu)])
    return {
        "constant": constant.tolist(),
        "by_state": slope[:, : 2 * n].tolist(),
        "by_control": slope[:, 2 * n :].tolist(),
    }
