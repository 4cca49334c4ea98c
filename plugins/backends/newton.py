"""Newton: the scene's twin in Newton's Featherstone solver, on Warp, in a Python of its own."""

from dataclasses import dataclass
from typing import Any, ClassVar

from bench.engines.backend import EngineBackend
from bench.model import Program, param

from ..contacts.penalty import Penalty


@dataclass(frozen=True)
class Newton(EngineBackend):
    """Gradients: adjoint pass over step Jacobians from a reverse-mode tape per step; float32.

    One tape over several steps of the Featherstone solver gives wrong gradients, since the solver overwrites its
    matrices. The solver's contacts are springs whose damper acts only while bodies approach.
    """

    name = "newton"
    file = "../engines/newton.py"
    libraries: ClassVar[tuple[str, ...]] = ("newton", "warp-lang", "numpy")

    dtype: str = param("float32", "floating-point type of the simulation", choices=("float32",))

    def unsupported_twin(self, program: Program, model: dict[str, Any]) -> str | None:
        """Return why the solver cannot run the twin: a contact damper that acts while bodies part; or None."""
        law = program.contact
        if isinstance(law, Penalty) and law.damping and law.damping_mode != "approach":
            return f"newton's contact damper acts on approach only: it supports damping_mode=approach, not {law.damping_mode}"
        return None
