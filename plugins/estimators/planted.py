"""A mean gradient with an error of known kind and size."""

import math
from dataclasses import dataclass

import numpy as np

from bench.model import Estimator, Problem, Program, Unsupported, best_gradient, first_order, param


@dataclass(frozen=True)
class Planted(Estimator):
    """Adds a bias, a rotation or a random error of stated size to a gradient, to measure what such an error costs.

    With g the gradient and u a unit vector that is fixed for each d, ``bias`` adds bias |g| u. ``angle`` turns g towards
    u within their plane and keeps its length: the error is 2 sin(angle / 2) |g|. ``noise`` adds an isotropic normal
    vector whose root mean square length is noise |g|; with ``tails`` it is a multivariate Student t vector of the same
    root mean square length. With ``scale=start``, bias and noise are relative to |g| at the start instead, and their
    relative size grows as the gradient falls, as sampling noise does. g is the mean gradient of the samples, or with
    ``base=best`` the gradient without noise, as a mean over fixed draws of a random start (the mean of costs times scores where the cost jumps). Without an error and with
    ``base=samples`` it equals ``fobg``. Requires gradients.
    """

    name = "planted"
    unbiased = False
    needs_directions = True
    needs_independent_samples = True

    base: str = param("samples", "gradient to which the error is added", choices=("samples", "best"))
    bias: float = param(0.0, "length of the fixed error, relative to the gradient's norm", low=0.0)
    angle: float = param(0.0, "angle of the rotation", "degrees", low=0.0, high=180.0)
    noise: float = param(0.0, "root mean square length of the random error, relative to the gradient's norm", low=0.0)
    tails: int | None = param(None, "degrees of freedom of a Student t error; null: a normal error", low=3)
    scale: str = param("here", "where the norm is taken that sizes are relative to", choices=("here", "start"))

    @property
    def needs(self) -> frozenset[str]:  # type: ignore[override]
        """Gradients; with ``base=best`` also costs and scores, which discontinuous costs need."""
        return frozenset({"grad"}) if self.base == "samples" else frozenset({"grad", "value", "score"})

    def draws_noise(self, program: Program) -> bool:
        return self.base == "samples" or self.noise > 0.0 or not program.continuous

    def own_refusal(self, program: Program) -> str | None:
        if self.angle and program.dim < 2:
            return f"{self.name}[angle={self.angle:g}] needs at least 2 coordinates, and theta has {program.dim}"
        return None

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the gradients with their errors, ``(R, d)``; Unsupported if too few samples remain for the base."""
        spare = self._spare(problem.program) if self.noise else 0
        is_exact = self.base == "best" and problem.program.continuous
        if noise.shape[1] < spare + (not is_exact):
            raise Unsupported(f"the planted noise needs {spare + 1} samples, got {noise.shape[1]}")
        own, used = noise[:, : noise.shape[1] - spare], noise[:, noise.shape[1] - spare :]
        g = self._base(problem, theta, own)
        norm = np.linalg.norm(g, axis=1, keepdims=True)
        size = norm
        if self.scale == "start" and (self.bias or self.noise):
            size = np.linalg.norm(self._base(problem, problem.program.theta0, own), axis=1, keepdims=True)
        u = direction(problem.dim)
        result = g
        if self.angle:
            across = norm * u - (g @ u)[:, None] * g / np.where(norm > 0, norm, 1.0)
            length = np.linalg.norm(across, axis=1, keepdims=True)
            turn = math.radians(self.angle)
            result = math.cos(turn) * g + math.sin(turn) * norm * across / np.where(length > 0, length, 1.0)
        if self.bias:
            result = result + self.bias * size * u
        if self.noise:
            result = result + self.noise * size * self._unit_errors(used, problem.dim)
        return result

    def _spare(self, program: Program) -> int:
        """Return the number of samples whose normal numbers make the random error."""
        return math.ceil((program.dim + (self.tails or 0)) / program.n_noise)

    def _base(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        if self.base == "best":
            return best_gradient(problem, theta, noise)
        return first_order(problem, theta, noise).mean(axis=1)

    def _unit_errors(self, noise: np.ndarray, d: int) -> np.ndarray:
        """Return isotropic random vectors ``(R, d)`` with a root mean square length of 1."""
        numbers = noise.reshape(len(noise), -1)
        errors = numbers[:, :d] / math.sqrt(d)
        if self.tails is None:
            return errors
        chi_square = (numbers[:, d : d + self.tails] ** 2).sum(axis=1, keepdims=True)
        # the variance of Student's t is tails / (tails - 2)
        return errors * np.sqrt((self.tails - 2) / chi_square)


def direction(d: int) -> np.ndarray:
    """Return the unit vector ``(d,)`` of biases and rotations: random, and the same for all problems of dimension d."""
    u = np.random.default_rng(d).standard_normal(d)
    return u / np.linalg.norm(u)
