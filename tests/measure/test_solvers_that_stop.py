"""Right implicit gradients over a solver that stops early: `rounding`, although differences contradict them slightly."""

import loose_solvers
import numpy as np
import pytest

from bench.measure import gradcheck


@pytest.mark.parametrize(
    ("tolerance", "name", "theta"),
    [
        (1e-6, "wave", (0.756454357174736, 0.9358523798492928)),
        (1e-6, "wave", (0.7339613334323125, 0.6447476550861408)),
        (1e-8, "square", (0.7983259614735267, 0.9616706775524602)),
    ],
)
def test_jumps_too_dense_for_a_wide_scan_are_rounding(tolerance, name, theta):
    """Within a hundredth of the input's size, one iteration more is needed several times."""
    cost, gradient = loose_solvers.problem(1.0, tolerance, *loose_solvers.COSTS[name])
    assert gradcheck.check(cost, gradient, np.array(theta)).cause == "rounding"


def test_a_wrong_gradient_over_such_a_solver_is_blamed():
    cost, gradient = loose_solvers.problem(1.0, 1e-6, *loose_solvers.COSTS["wave"])
    theta = np.array([0.756454357174736, 0.9358523798492928])
    assert gradcheck.check(cost, lambda t: 1.005 * gradient(t), theta).cause in gradcheck.FAULTS
