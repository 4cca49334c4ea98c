"""Counts verdicts on right implicit gradients over solvers that stop early: `python validation/loose_solvers.py [COUNT]`.

x solves x = a cos x + b by a fixed-point or a damped iteration that ends at a change below 1e-6 or 1e-8. Three costs of x are
checked at COUNT random (a, b) each. Verdicts other than right ones are false alarms.
"""

import sys
from collections import Counter

import numpy as np

from bench import gradient as gradcheck

MOST = 2000
"""Most iterations, since far from the given theta an iteration may run in a circle."""
COSTS = {
    "square": (lambda x, t: (x - 2.0) ** 2 + 0.1 * (t * t).sum(axis=0), lambda x, t: (2.0 * (x - 2.0), 0.2 * t)),
    "linear": (lambda x, t: x, lambda x, t: (1.0, 0.0 * t)),
    "wave": (
        lambda x, t: np.sin(3.0 * x) + t[1] ** 2,
        lambda x, t: (3.0 * np.cos(3.0 * x), np.array([0.0, 2.0 * t[1]])),
    ),
}


def problem(rate, tolerance, value, slopes):
    """Return cost and gradient for an iteration that moves x by ``rate`` times the residual."""

    def solve(thetas):
        """Return the solutions ``(B,)`` for the columns ``(2, B)``, each of which stops on its own; NaN where one does not."""
        x, is_moving = np.zeros(thetas.shape[1]), np.ones(thetas.shape[1], dtype=bool)
        for _ in range(MOST):
            change = rate * (thetas[0] * np.cos(x) + thetas[1] - x)
            x = np.where(is_moving, x + change, x)
            is_moving &= np.abs(change) > tolerance
            if not is_moving.any():
                break
        return np.where(is_moving, np.nan, x)

    def cost(thetas):
        values = np.full(thetas.shape[1], np.nan)
        converges = np.abs(thetas[0]) < 1.2
        values[converges] = value(solve(thetas[:, converges]), thetas[:, converges])
        return values

    def gradient(t):
        x = float(solve(t[:, None])[0])
        by_x, direct = slopes(x, t)
        return by_x * np.array([np.cos(x), 1.0]) / (1.0 + t[0] * np.sin(x)) + direct

    return cost, gradient


def verdicts(rate, tolerance, count):
    """Return the counts of verdicts at ``count`` random thetas per cost."""
    random, found = np.random.default_rng(0), Counter()
    for name, pair in COSTS.items():
        for _ in range(count):
            theta = np.array([random.uniform(0.2, 0.8), random.uniform(-1.0, 1.0)])
            result = gradcheck.check(*problem(rate, tolerance, *pair), theta)
            found[result.cause] += 1
            if result.cause not in gradcheck.TRUSTED:
                print(f"blamed: {name} at {theta.tolist()}: {result.sentence()}", flush=True)
    return found


if __name__ == "__main__":
    total = Counter()
    for name, rate in (("fixed point", 1.0), ("damped", 0.5)):
        for tolerance in (1e-6, 1e-8):
            found = verdicts(rate, tolerance, int(sys.argv[1]) if len(sys.argv) > 1 else 36)
            total += found
            print(
                f"{name}, {tolerance:g}: " + ", ".join(f"{n} {cause}" for cause, n in found.most_common()), flush=True
            )
    wrong = sum(n for cause, n in total.items() if cause not in gradcheck.TRUSTED)
    print(f"{wrong} of {total.total()} right gradients blamed")
