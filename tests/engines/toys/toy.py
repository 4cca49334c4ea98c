"""A point mass on a spring floor, in another Python."""

from dataclasses import dataclass

from bench.plugin import EngineBackend, param


@dataclass(frozen=True)
class Toy(EngineBackend):
    """Gradients: closed-form step Jacobians of a point mass over a spring floor; float64."""

    name = "toy"
    file = "engines/toy.py"
    libraries = ("numpy",)

    fault: str = param("", "no_contact, or what happens when Jacobians are computed: exit, loop, memory or raise")
