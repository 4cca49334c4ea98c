"""nimblephysics: the scene's twin with rigid contact by a complementarity problem, in a Python of its own."""

from dataclasses import dataclass
from typing import ClassVar

from bench.engines.backend import EngineBackend
from bench.model import param


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
