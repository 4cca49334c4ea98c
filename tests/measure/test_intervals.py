"""Coverage of the intervals on the bank's cells, none of which chose a constant."""

import intervals
import pytest


@pytest.mark.slow
def test_intervals_hold_the_truth():
    """280 cells; 20 sets of estimates each."""
    assert len(intervals.cells()) >= 150
    assert intervals.main(20) == 0
