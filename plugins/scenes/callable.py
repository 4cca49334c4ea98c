"""A user's own simulator, named by its file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.model import CallableScene, load_simulator, param, simulator_files


@dataclass(frozen=True)
class Callable(CallableScene):
    """f(theta, w) = cost(theta + sigma u, v), with a function from a user's file as the cost; w = (u, v).

    theta is defined in the file or by ``theta0=[..]``. Without ``grad``, gradients are central differences.
    """

    name = "callable"
    neglected_effects = "those that the simulator neglects"
    backends = ("callable",)

    cost: str = param("bench.simulator.example:cost", "the cost, as FILE:NAME or MODULE:NAME")
    theta: str = param("theta", "theta: a name in the file")
    grad: str = param("gradient", "jax, torch, or a function of theta in the file; empty for differences")
    batch: str = param("", "how the cost evaluates several thetas: loop, vmap, columns or rows; detected by default")
    own_noise: int = param(0, "length of the cost's own noise", low=0)

    def simulator(self) -> Any:
        """Return the user's functions, loaded once."""
        return load_simulator(self.cost, self.theta, self.grad, self.batch, self.own_noise)

    def files(self) -> tuple[Path, ...]:
        return simulator_files(self.cost)
