"""Coverage of the intervals on the bank's cells, none of which chose a constant."""

import intervals
import pytest


@pytest.mark.slow
def test_intervals_hold_the_truth():
    """20 sets of estimates for every fifth of 280 cells: bias, variance and variance per sample."""
    assert len(intervals.bank_cells()) >= 280
    assert intervals.main(20, 5) == 0
