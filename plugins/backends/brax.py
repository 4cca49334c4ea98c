"""Brax: the scene's twin in the generalized pipeline, in a Python of its own."""

from dataclasses import dataclass

from bench.engines.backend import EngineBackend
from bench.model import param


@dataclass(frozen=True)
class Brax(EngineBackend):
    """Gradients: JAX's forward mode of each step of Brax's generalized pipeline, chained; float64.

    A contact cancels a share ``impedance`` of all other forces. The solver of contact forces starts with a step of 1 and
    halves it at most ``halvings`` times: at Brax's own default, 20, contacts of light bodies and of small impedances have
    no force, without an error. It stops at a tolerance. Brax's physics is no longer maintained.
    """

    name = "brax"
    file = "../engines/brax.py"
    reads_mjcf = True
    damping_mode = "clipped"
    solver_error = 1e-6
    libraries = ("brax", "jax", "mujoco", "mujoco-mjx", "numpy")

    impedance: float = param(0.01, "share of other forces that a contact cancels", low=1e-3, high=0.9999)
    halvings: int = param(60, "most halvings of a step of the contact solver", positive=True)
