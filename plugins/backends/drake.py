"""Drake: the scene's twin as a multibody plant with point contact, in a Python of its own."""

from dataclasses import dataclass

from bench.engines.backend import EngineBackend
from bench.model import param


@dataclass(frozen=True)
class Drake(EngineBackend):
    """Gradients: forward mode (AutoDiffXd) of each step, chained; float64; one rollout at a time.

    Contact is Drake's: point contact with the law's stiffness and a solver that treats it implicitly, so that a spring
    without damping loses energy.
    """

    name = "drake"
    file = "../engines/drake.py"
    reads_mjcf = True
    libraries = ("drake", "numpy")
    own_contact = True

    dissipation: float = param(0.0, "Hunt and Crossley's dissipation of contacts", "s/m", low=0.0)
