"""Targets of a critic against sums of TD errors."""

import numpy as np
import pytest

from bench.training.windows import td_lambda


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
