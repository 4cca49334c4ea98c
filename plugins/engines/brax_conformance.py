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
    "motor[@gear]": "a motor has one axis",
}
"""Elements that Brax runs in another way than MuJoCo, or ignores."""


class Engine(SteppedEngine):
    """A system per case, with its actuators."""

    versions = {name: importlib.metadata.version(name) for name in ("brax", "jax")}
    tolerance = 1e-3  # the solver of contacts and limits stops early
    in_world = False

    def build(self, case):
        """Return the system, and an actuator for each control."""
        self.differs[case.name] = differing(ElementTree.parse(case.model).getroot(), DIFFERENT)
        return System(mjcf.load(str(case.model)).replace(solver_maxls=60)), np.eye(case.controls.shape[1])
