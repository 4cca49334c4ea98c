"""A point mass on a spring floor, in another Python."""

from dataclasses import dataclass

from bench.plugin import EngineBackend


@dataclass(frozen=True)
class Toy(EngineBackend):
    """Gradients: closed-form step Jacobians of point masses on a line over a spring floor; float64."""

    name = "toy"
    file = "engines/toy.py"
    libraries = ("numpy",)
