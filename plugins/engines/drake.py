"""Drake's multibody plant with point contact, differentiated forward by AutoDiffXd, a column at a time."""

import pydrake.all as drake
from drake_plant import Plant
from twin_bodies import bodies


class Model(Plant):
    """A twin as a plant."""

    takes_forces = True

    def __init__(self, program):
        material = drake.ProximityProperties()
        # two compliant bodies are springs in series
        stiffness = 2.0 * program["contact"].get("stiffness", 1.0)
        friction = drake.CoulombFriction(0.0, 0.0)
        drake.AddContactMaterial(program["backend"]["dissipation"], stiffness, friction, material)
        super().__init__(bodies(program), program["dt"], material)
