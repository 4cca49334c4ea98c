"""Targets of a critic against cases worked out by hand, and against sums over all lengths."""

import numpy as np
import pytest

from bench.training.windows import td_lambda

ROUNDING = 1e-12
"""Relative error allowed to float64 sums of a few terms."""


def test_td_lambda_agrees_with_a_hand_computed_case():
    """Three steps, gamma 1/2, lambda 1/2, the middle one ends an episode with the value of its last state.

    G_2 = 4 + 1/2 * 8 = 8. G_1 = 2 + 1/2 * 6 = 5, without G_2. G_0 = 1 + 1/2 (1/2 * 2 + 1/2 * 5) = 2.75.
    """
    reward = np.array([[1.0], [2.0], [4.0]])
    value = np.array([[2.0], [6.0], [8.0]])
    ended = np.array([[False], [True], [False]])
    assert np.asarray(td_lambda(reward, value, ended, 0.5, 0.5))[:, 0] == pytest.approx([2.75, 5.0, 8.0], rel=ROUNDING)


def test_advantages_are_discounted_sums_of_td_errors_up_to_an_end():
    """Equation 16 of Schulman et al. 2016, with a sum that stops where an episode ends."""
    rng = np.random.default_rng(1)
    h, gamma, lam = 5, 0.95, 0.8
    reward, before, value = rng.standard_normal((3, h, 1))
    value[:2] = before[1:3]  # within an episode the reached state is the next one
    value[3] = before[4]
    ended = np.zeros((h, 1), dtype=bool)
    ended[2] = True
    errors = (reward + gamma * value - before)[:, 0]
    expected = [sum((gamma * lam) ** (k - t) * errors[k] for k in range(t, 3 if t < 3 else h)) for t in range(h)]
    assert np.asarray(td_lambda(reward, value, ended, gamma, lam) - before)[:, 0] == pytest.approx(expected, rel=1e-10)
