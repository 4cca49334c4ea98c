"""nimblephysics: the scene's twin with rigid contact by a complementarity problem, in a Python of its own."""

from dataclasses import dataclass
from typing import Any, ClassVar

from bench.engines.backend import EngineBackend
from bench.model import Program, param


@dataclass(frozen=True)
class Nimble(EngineBackend):
    """Gradients: nimblephysics' analytical Jacobians of each step, chained; float64; one rollout at a time.

    Contact is rigid, with the scene's restitution: it stands for ``impulse``. Positions advance by the velocity before
    the step.
    """

    name = "nimble"
    file = "../engines/nimble.py"
    libraries: ClassVar[tuple[str, ...]] = ("nimblephysics", "torch", "numpy")
    laws: ClassVar[tuple[str, ...]] = ("impulse",)
    own_contact = True

    dtype: str = param("float64", "floating-point type of the simulation", choices=("float64",))

    def unsupported_twin(self, program: Program, model: dict[str, Any]) -> str | None:
        """Return why the engine cannot run the twin: friction; or None."""
        if any(contact["friction"] for contact in model["contacts"]):
            return "nimble's twins have no friction"
        return None
