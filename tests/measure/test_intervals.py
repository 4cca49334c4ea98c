"""Coverage of the intervals on the bank's cells, none of which chose a constant."""

import intervals
import pytest


@pytest.mark.parametrize("stride", [pytest.param(10, marks=pytest.mark.slow), pytest.param(5, marks=pytest.mark.full)])
def test_intervals_hold_the_truth(stride):
    """20 sets of estimates for some of 280 cells: bias, variance and variance per sample."""
    assert len(intervals.cells()) >= 280
    assert intervals.main(20, stride) == 0
