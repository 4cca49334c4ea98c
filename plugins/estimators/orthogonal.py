"""Zeroth order along orthogonal directions."""

from dataclasses import dataclass

import numpy as np

from bench.model import Estimator, Problem, mean_difference, param


@dataclass(frozen=True)
class Orthogonal(Estimator):
    """Approximates grad J_s with (f(theta + s v) - f(theta - s v)) v / 2s, where the v of up to d samples are orthogonal.

    Each block of d samples is a random rotation and covers all directions. With ``lengths=drawn`` each v has the length
    of its own normal vector and is normally distributed: unbiased, like ``randomized_smoothing``. With
    ``lengths=fixed`` all v have the length sqrt(d): the target is then another smoothing, and d samples are exact for a
    linear cost (Choromanski et al. 2018). A last block of fewer than d samples leaves directions out, so the error is larger
    if N is not a multiple of d: with d = 50 on the pendulum, 0.20 at N = 50, 0.39 at 64, 0.14 at 100 and 0.23 at 128.
    Requires only costs.
    """

    name = "orthogonal"
    needs_directions = True
    smooths_theta = True
    unbiased_at_discontinuities = True
    couples_samples = True
    needs_independent_samples = True

    lengths: str = param("drawn", "lengths of the directions", choices=("drawn", "fixed"))

    @property
    def unbiased(self) -> bool:  # type: ignore[override]
        """True for drawn lengths."""
        return self.lengths == "drawn"

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        d = problem.dim
        normal = noise[..., :d]
        v = np.concatenate([_rotated(normal[:, i : i + d]) for i in range(0, noise.shape[1], d)], axis=1)
        lengths = np.linalg.norm(normal, axis=2, keepdims=True) if self.lengths == "drawn" else np.sqrt(d)
        return mean_difference(problem, theta, lengths * v, noise)


def _rotated(normal: np.ndarray) -> np.ndarray:
    """Return random orthonormal vectors from normal vectors ``(R, m, d)``, m <= d, of the same shape.

    They are uniform over rotations except for their signs, which the QR factorisation chooses. A central difference
    times its direction does not depend on the sign.
    """
    return np.moveaxis(np.linalg.qr(np.moveaxis(normal, 1, 2))[0], 2, 1)
