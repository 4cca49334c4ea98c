"""Zeroth order along directions that cover the normal distribution evenly."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from bench.model import Estimator, Problem, Program, mean_difference

BITS = 52
"""Binary digits of a coordinate: the centres of 2^52 equal intervals are numbers of double precision."""
MOST = 21201
"""Largest dimension of SciPy's Sobol sequence."""


@dataclass(frozen=True)
class Sobol(Estimator):
    """Approximates grad J_sigma with (f(theta + sigma v) - f(theta - sigma v)) v / 2 sigma along quasi-random v.

    The v of a repeat are the first N points of the Sobol sequence with a random digital shift, mapped to the normal
    distribution (L'Ecuyer, Lemieux 2002). Each v is normally distributed, so the estimate is unbiased for any cost, and
    repeats are independent. Its variance can fall faster than 1 / N, as for other gradients by quasi-Monte Carlo
    (Buchholz et al. 2018): the most for a smooth cost of few variables and N a power of 2. At a jump the gain depends on
    d: the variance is of order N^-2 for one variable, and about N^(-1 - 1/d) for a plane oblique to the axes, as it cuts
    N^(1 - 1/d) of N cells. The shift is the mean of the repeat's noise, the only random number that it uses besides noise
    of the scene's own. Requires only costs.
    """

    name = "sobol"
    needs_directions = True
    smooths_theta = True
    unbiased_at_discontinuities = True
    couples_samples = True
    needs_independent_samples = True

    def own_refusal(self, program: Program) -> str | None:
        if program.dim > MOST:
            return f"{self.name} has directions of at most {MOST:,} coordinates, and theta has {program.dim:,}"
        return None

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the mean of central differences along the quasi-random directions, ``(R, d)``."""
        return mean_difference(problem, theta, directions(noise[..., : problem.dim]), noise)


def directions(noise: np.ndarray) -> np.ndarray:
    """Return quasi-random, standard normal directions ``(R, N, d)``. Repeat r depends on ``noise[r]`` only."""
    from scipy.special import ndtr, ndtri

    count, d = noise.shape[1:]
    # the mean times sqrt(N) is standard normal, so its probability is uniform, and depends on each sample
    uniform = ndtr(math.sqrt(count) * noise.mean(axis=1, keepdims=True))
    digits = np.minimum(uniform * 2.0**BITS, 2.0**BITS - 1.0).astype(np.uint64)
    return ndtri(((points(count, d) ^ digits) + 0.5) / 2.0**BITS)


@lru_cache(maxsize=8)
def points(count: int, d: int) -> np.ndarray:
    """Return the first ``count`` points of the Sobol sequence in d dimensions as integers below 2^52, ``(count, d)``."""
    from scipy.stats import qmc

    digits = math.ceil(math.log2(max(count, 2)))
    sequence = qmc.Sobol(d, scramble=False, bits=max(digits, 30)).random_base2(digits)[:count]
    integers = np.asarray(sequence * 2.0**BITS, dtype=np.uint64)
    integers.setflags(write=False)
    return integers
