"""Brax's generalized pipeline in the conformance set, differentiated forward by JAX."""

import importlib.metadata
import xml.etree.ElementTree as ElementTree

import numpy as np
from brax.io import mjcf
from brax_system import System
from free_bodies import SteppedEngine, differing

CONTACTS = "forces f >= 0 of contacts minimise |A f + b|^2"
DIFFERENT = {
    "geom[@type='plane']": CONTACTS,
    "contact/pair": CONTACTS,
    "option[@viscosity]": "no fluids and no gravity compensation",
    "body[@gravcomp]": "no fluids and no gravity compensation",
    "joint[@frictionloss]": "no friction loss",
    "equality/": "no equalities",
    "tendon/": "no tendons",
    "joint[@damping]": "dampers of joints are explicit",
}
"""Elements that Brax runs in another way than MuJoCo, or ignores."""


class Engine(SteppedEngine):
    """A system per case, with its actuators."""

    versions = {name: importlib.metadata.version(name) for name in ("brax", "jax")}
    tolerance = 1e-3  # the solver of contacts and limits stops early
    in_world = False

    def build(self, case):
        """Return the system, and an actuator for each control."""
        root = ElementTree.parse(case.model).getroot()
        if root.find(".//joint[@type='ball']") is not None:
            raise NotImplementedError("ball joints are not supported")
        others = [
            number for motor in root.iter("motor") for number in motor.get("gear", "").split()[1:] if float(number)
        ]
        self.differs[case.name] = differing(
            root, DIFFERENT | {"actuator": "a motor has one axis"} if others else DIFFERENT
        )
        return System(mjcf.load(str(case.model)).replace(solver_maxls=60)), np.eye(case.controls.shape[1])

    def _force(self, case, x, force):
        """Return the controls of the system's own actuators, of which there may be fewer than velocities."""
        return force
