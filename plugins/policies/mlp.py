"""A neural network with fully connected layers."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, Policy, UserError, affine, param


@dataclass(frozen=True)
class Mlp(Policy):
    """A multilayer perceptron: hidden layers with an activation function, and a linear last layer.

    Theta holds weight and bias of each layer in turn. Initial weights are normal with deviation 1 / sqrt(inputs of the
    layer) (LeCun et al. 1998), in the last layer times ``scale``; initial biases are 0.
    """

    name = "mlp"

    hidden: str = param("64x64", "widths of the hidden layers, as 64x64")
    activation: str = param("tanh", "activation function of the hidden layers", choices=("tanh", "elu", "relu"))
    scale: float = param(0.1, "factor on the initial weights of the last layer", low=0.0)
    seed: int = param(0, "seed of the initial weights", low=0)

    def __post_init__(self) -> None:
        parts = self.hidden.split("x")
        if not all(part.isdecimal() and int(part) > 0 for part in parts):
            raise UserError(f"mlp.hidden={self.hidden!r} must be widths such as 64x64, or 32 for one layer")

    @property
    def widths(self) -> list[int]:
        """The widths of the hidden layers."""
        return [int(part) for part in self.hidden.split("x")]

    def shapes(self, n_inputs: int, n_outputs: int) -> dict[str, tuple[int, ...]]:
        """Return ``weight_i (outputs, inputs)`` and ``bias_i (outputs,)`` of each layer i, from 0."""
        sizes = [n_inputs, *self.widths, n_outputs]
        shapes: dict[str, tuple[int, ...]] = {}
        for i, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
            shapes |= {f"weight_{i}": (n_out, n_in), f"bias_{i}": (n_out,)}
        return shapes

    def initial(self, n_inputs: int, n_outputs: int) -> np.ndarray:
        random, parts = np.random.default_rng(self.seed), []
        last = f"weight_{len(self.widths)}"
        for name, shape in self.shapes(n_inputs, n_outputs).items():
            if name.startswith("bias"):
                parts.append(np.zeros(shape))
            else:
                factor = self.scale if name == last else 1.0
                parts.append((factor / np.sqrt(shape[1]) * random.standard_normal(shape)).ravel())
        return np.concatenate(parts)

    def act(self, xp: Any, theta: Array, observations: Array) -> Array:
        *_, width = sizes = [observations.shape[0], *self.widths]
        before = sum((n_in + 1) * n_out for n_in, n_out in itertools.pairwise(sizes))
        arrays = self.arrays(xp, theta, observations.shape[0], (theta.shape[0] - before) // (width + 1))
        x, layers = observations, len(self.widths)
        for i in range(layers + 1):
            x = affine(xp, arrays[f"weight_{i}"], arrays[f"bias_{i}"], x)
            if i < layers:
                x = self._activated(xp, x)
        return x

    def _activated(self, xp: Any, x: Array) -> Array:
        if self.activation == "tanh":
            return xp.tanh(x)
        negative = xp.where(x > 0, 0.0 * x, x)  # the derivative of exp must not overflow where it is not used
        return xp.where(x > 0, x, xp.exp(negative) - 1.0 if self.activation == "elu" else 0.0 * x)
