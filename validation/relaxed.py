"""Measures the error of the central path's gradient at ``kappa``: ``python validation/relaxed.py 1e-6``.

Prints, per stiffness of ``stiffness_sweep``, the relative difference between the mean gradients of ``pushing`` at ``kappa``
and at ``kappa`` / 1000, over the same draws.
"""

import sys

import numpy as np

from bench.model import compose, registry

STIFFNESSES = (1e1, 1e2, 1e3, 3e3, 1e4, 1e5, 1e6)
SIGMA, DRAWS = 0.1, 512


def mean_gradient(stiffness, kappa, draws=DRAWS):
    """Return the mean gradient ``(d,)`` under the law, over draws that are the same for all arguments."""
    law = registry.make("contacts", "complementarity", {"stiffness": stiffness, "kappa": kappa})
    step = registry.make("integrators", "semi_implicit_euler", {})
    program = compose(registry.make("scenes", "pushing", {"sigma": SIGMA}), law, step)
    problem = registry.make("backends", "implicit", {}).compile(program)
    w = SIGMA * np.random.default_rng(0).standard_normal((program.n_noise, draws))
    return problem.grad(program.theta0, w).mean(axis=1)


if __name__ == "__main__":
    kappa = float(sys.argv[1]) if len(sys.argv) > 1 else 1e-6
    for stiffness in STIFFNESSES:
        spring = mean_gradient(stiffness, 1e-3 * kappa)
        off = np.linalg.norm(mean_gradient(stiffness, kappa) - spring) / np.linalg.norm(spring)
        print(f"k = {stiffness:g} N/m: {100 * off:.2g}% of the gradient")
