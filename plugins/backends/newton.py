"""Newton: the scene's twin in one of Newton's solvers, on Warp, in a Python of its own."""

from dataclasses import dataclass
from typing import Any

from bench.engines.backend import EngineBackend
from bench.model import Program, param

RIGID = {"provides": frozenset({"value", "score", "physics"}), "laws": ("impulse",), "own_contact": True}
"""What is different for ``solver=xpbd``: contacts are rigid, with the scene's restitution, and there are no gradients."""


@dataclass(frozen=True)
class Newton(EngineBackend):
    """Gradients: adjoint pass over step Jacobians from a reverse-mode tape per step; float32.

    One tape over several steps of the Featherstone solver gives wrong gradients, since the solver overwrites its
    matrices. Contacts are springs whose damper acts only while bodies approach.

    ``semi_implicit`` and ``xpbd`` have no joint coordinates: they run bodies on slides of the world, without linked
    bodies or hinges. ``xpbd`` stands for the law ``impulse`` and has no gradients: the tape of its step leaves out the
    bounce.
    """

    name = "newton"
    file = "../engines/newton.py"
    libraries = ("newton", "warp-lang", "numpy")
    damping_mode = "approach"

    dtype: str = param("float32", "floating-point type of the simulation", choices=("float32",))
    solver: str = param("featherstone", "Newton's solver", choices=("featherstone", "semi_implicit", "xpbd"))

    def __post_init__(self) -> None:
        if self.solver == "xpbd":
            vars(self).update(RIGID)

    def twin_refusal(self, program: Program, model: dict[str, Any]) -> str | None:
        """Return why the solver cannot run the twin: hinges or links; or None."""
        has_links = any(body["joint"] != "slide" or body["parent"] >= 0 for body in model["bodies"])
        if self.solver != "featherstone" and has_links:
            return (
                f"newton's {self.solver} solver has no joint coordinates: it supports bodies on slides only, each attached "
                "to the world; use solver=featherstone"
            )
        return None
