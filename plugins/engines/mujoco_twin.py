"""Twins as MuJoCo models, for engines that take these."""

import xml.etree.ElementTree as ElementTree

import mujoco
import numpy as np
from twin_bodies import bodies


def mujoco_model(program):
    """Return the twin as a MuJoCo model, with a motor of gear 1 per joint in place of its motors, springs and dampers."""
    root = bodies(program)
    motors = ElementTree.SubElement(root, "actuator")
    for joint in root.iter("joint"):
        ElementTree.SubElement(motors, "motor", joint=joint.get("name"))
    if root.find(".//geom") is None:  # Brax's validation fails without any
        ElementTree.SubElement(root.find("worldbody"), "geom", size="0.1", contype="0", conaffinity="0")
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    model.opt.timestep = program["dt"]
    if model.npair:
        law, impedance = program["contact"], program["backend"]["impedance"]
        pairs = model.geom_bodyid[np.stack([model.pair_geom1, model.pair_geom2])]
        friction = model.pair_friction[:, 0]
        # a contact is four edges of a friction pyramid, which together push with 2 / (mu^2 (1 + mu^2)) times one spring
        inverse_mass = model.body_invweight0[pairs, 0].sum(axis=0) * friction**2 * (1 + friction**2) / 2
        model.pair_solref[:] = -np.array([law["stiffness"], law["damping"]]) * inverse_mass[:, None]
        model.pair_solimp[:, :2] = impedance
    return model
