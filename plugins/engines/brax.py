"""Brax's generalized pipeline, differentiated forward by JAX, all columns together."""

import xml.etree.ElementTree as ElementTree

import jax
import mujoco
import numpy as np
from brax.generalized import pipeline
from brax.io import mjcf

jax.config.update("jax_enable_x64", True)


class Model:
    """A twin as a Brax system, compiled for each width."""

    takes_forces = True
    widths = (64, 2048)

    def __init__(self, program):
        n, system = len(program["bodies"]), mjcf.load_model(_mujoco_model(program))
        if program["contacts"]:
            _check_contacts(system)

        def step(x, u):
            state = pipeline.init(system, x[:n], x[n:])
            state = pipeline.step(system, state, u)
            return jax.numpy.concatenate([state.q, state.qd])

        self._step = jax.jit(jax.vmap(step, -1, -1))
        self._jacobians = jax.jit(jax.vmap(jax.jacfwd(step, (0, 1)), -1, -1))

    def step(self, x, u):
        """Return the states after one step."""
        return np.asarray(self._step(x, u))

    def jacobians(self, x, u):
        """Return the derivatives of one step."""
        return [np.asarray(part) for part in self._jacobians(x, u)]


def _mujoco_model(program):
    """Return the twin as a MuJoCo model, with a motor of gear 1 per joint in place of its motors, springs and dampers."""
    root = ElementTree.fromstring(f'<mujoco><option gravity="0 0 0"/>{program["mjcf"]}</mujoco>')
    for tag in ("actuator", "tendon"):
        for node in root.findall(tag):
            root.remove(node)
    motors = ElementTree.SubElement(root, "actuator")
    for joint in root.iter("joint"):
        joint.attrib.pop("damping", None)
        joint.attrib.pop("stiffness", None)
        ElementTree.SubElement(motors, "motor", joint=joint.get("name"))
    if root.find(".//geom") is None:  # Brax's validation fails without any
        ElementTree.SubElement(root.find("worldbody"), "geom", size="0.1", contype="0", conaffinity="0")
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    model.opt.timestep = program["dt"]
    if model.npair:
        law, impedance = program["contact"], program["backend"]["impedance"]
        bodies = model.geom_bodyid[np.stack([model.pair_geom1, model.pair_geom2])]
        friction = model.pair_friction[:, 0]
        # a contact is four edges of a friction pyramid, which together push with 2 / (mu^2 (1 + mu^2)) times one spring
        inverse_mass = model.body_invweight0[bodies, 0].sum(axis=0) * friction**2 * (1 + friction**2) / 2
        model.pair_solref[:] = -np.array([law["stiffness"], law["damping"]]) * inverse_mass[:, None]
        model.pair_solimp[:, :2] = impedance
    return model


def _check_contacts(system):
    from mujoco import mjx

    if mjx.make_data(system).ncon == 0:
        raise NotImplementedError("Brax finds no contacts in the twin")
