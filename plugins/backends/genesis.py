"""Genesis: the scene's twin in its rigid solver, in a Python of its own."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.engines.backend import EngineBackend
from bench.model import Program, param


@dataclass(frozen=True)
class Genesis(EngineBackend):
    """Gradients: Genesis' own backward pass of each step, chained; float64.

    A contact cancels a share ``impedance`` of all other forces. Genesis has no contact without friction, so it runs a
    contact of bodies on slides along its normal, where friction has no effect.
    """

    name = "genesis"
    file = "../engines/genesis.py"
    libraries = ("genesis-world", "torch", "numpy")
    damping_mode = "clipped"

    impedance: float = param(3e-4, "share of other forces that a contact cancels", low=3e-4, high=0.99)

    def twin_refusal(self, program: Program, model: dict[str, Any]) -> str | None:
        """Return why Genesis cannot run the program: contacts that slide, or several of them; or None."""
        contacts = model["contacts"]
        if len(contacts) > 1:
            return "genesis runs one contact per program"
        bodies = [model["bodies"][i] for contact in contacts for i in contact["bodies"] if i >= 0]
        is_free = all(body["joint"] == "slide" and body["parent"] < 0 for body in bodies)
        between = np.subtract(bodies[0]["centre"], bodies[-1]["centre"]) if len(bodies) == 2 else [0.0, 0.0, 1.0]
        lines = [body["axis"] for body in bodies] + [between]
        if not is_free or any(np.cross(lines[0], line).any() for line in lines):
            return "genesis has no contact without friction: it supports contacts along the slides of their bodies only"
        return None
