"""Taichi: the scene's twin as a kernel of spheres on slides, in a Python of its own."""

from dataclasses import dataclass
from typing import Any

from bench.engines.backend import EngineBackend
from bench.model import Program


@dataclass(frozen=True)
class Taichi(EngineBackend):
    """Gradients: reverse mode of a Taichi kernel per step, chained; float64. Spheres on slides, contacts are springs."""

    name = "taichi"
    file = "../engines/taichi.py"
    libraries = ("taichi", "numpy")
    damping_mode = ""

    def twin_refusal(self, program: Program, model: dict[str, Any]) -> str | None:
        """Return why the kernel cannot run the twin: hinges, linked bodies or damped contacts; or None."""
        if any(body["joint"] != "slide" or body["parent"] >= 0 for body in model["bodies"]):
            return "taichi's kernel has bodies on slides only, each attached to the world"
        return None
