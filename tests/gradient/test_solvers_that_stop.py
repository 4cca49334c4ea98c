"""Implicit gradients over a solver that stops early: right ones pass, although differences contradict them slightly."""

import loose_solvers
import numpy as np
import pytest

from bench import gradient as gradcheck

DENSE = [
    (1.0, 1e-6, "wave", (0.756454357174736, 0.9358523798492928)),
    (1.0, 1e-6, "wave", (0.7339613334323125, 0.6447476550861408)),
    (1.0, 1e-8, "square", (0.7983259614735267, 0.9616706775524602)),
]
"""Rate, tolerance, cost and theta: within a hundredth of the input's size, one iteration more is needed several times."""
ALONE = [(rate, tolerance, "square", (0.4, 0.5)) for rate in (1.0, 0.5) for tolerance in (1e-6, 1e-8)]
"""Between two counts of iterations, the cost has the derivative of the iteration, not of the solution."""


@pytest.mark.parametrize("case", [*DENSE, *ALONE], ids=str)
def test_a_right_gradient_passes_and_a_wrong_one_does_not(case):
    rate, tolerance, name, theta = case
    cost, gradient = loose_solvers.problem(rate, tolerance, *loose_solvers.COSTS[name])
    found = gradcheck.check(cost, gradient, np.array(theta)).cause
    assert found == "rounding" if case in DENSE else found in gradcheck.TRUSTED
    wrong = gradcheck.check(cost, lambda t: gradient(t) * [1.005, 1.001], np.array(theta)).cause
    assert wrong not in gradcheck.TRUSTED
