"""Brax: the scene's twin in the generalized pipeline, in a Python of its own."""

from dataclasses import dataclass
from typing import Any

from bench.engines.backend import EngineBackend
from bench.model import Program, param

from ..contacts.penalty import Penalty


@dataclass(frozen=True)
class Brax(EngineBackend):
    """Gradients: JAX's forward mode of each step of Brax's generalized pipeline, chained; float64.

    A contact cancels a share ``impedance`` of all other forces. The solver of contact forces starts with a step of 1 and
    halves it at most ``halvings`` times: at Brax's own default, 20, contacts of light bodies and of small impedances have
    no force, without an error. It stops at a tolerance. Brax's physics is no longer maintained.
    """

    name = "brax"
    file = "../engines/brax.py"
    helpers = ("mujoco_twin.py",)
    solver_error = 1e-6
    libraries = ("brax", "jax", "mujoco", "mujoco-mjx", "numpy")

    dtype: str = param("float64", "floating-point type of the simulation", choices=("float64",))
    impedance: float = param(0.01, "share of other forces that a contact cancels", low=1e-3, high=0.9999)
    halvings: int = param(60, "most halvings of a step of the contact solver", positive=True)

    def unsupported_twin(self, program: Program, model: dict[str, Any]) -> str | None:
        """Return why Brax cannot run the program: a damper that pulls; or None."""
        law = program.contact
        if isinstance(law, Penalty) and law.damping and law.damping_mode != "clipped":
            return f"brax's contacts never pull: it supports damping_mode=clipped only, not {law.damping_mode}"
        return None
