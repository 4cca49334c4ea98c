"""Common random numbers: what their key holds, what is kept when more are drawn, and that nobody can change them."""

import numpy as np
import pytest

from bench.measure import noise

KEY = {"seed": 3, "scene": "one", "repeats": 2, "samples": 5, "width": 3, "stream": "cells"}


@pytest.mark.parametrize("other", [{"seed": 4}, {"scene": "two"}, {"stream": "check"}])
def test_every_part_of_the_key_counts(other):
    assert not np.intersect1d(noise.draw(**KEY), noise.draw(**KEY | other)).size
    np.testing.assert_array_equal(noise.draw(**KEY), noise.draw(**KEY))


def test_repeats_differ_and_stay_when_there_are_more():
    drawn = noise.draw(**KEY)
    assert drawn.shape == (2, 5, 3)
    assert np.unique(drawn).size == drawn.size
    more = noise.draw(**KEY | {"repeats": 4, "samples": 9})
    np.testing.assert_array_equal(more[:2, :5], drawn)


def test_nobody_can_change_what_cells_share():
    with pytest.raises(ValueError, match="read-only"):
        noise.draw(**KEY)[0, 0, 0] = 1.0


def test_parts_end_with_the_last_sample(monkeypatch):
    monkeypatch.setattr(noise, "HELD", 6)
    parts = list(noise.parts(3, "one", 1, 5, 3, "cells"))
    assert [part.shape for part in parts] == [(3, 2), (3, 2), (3, 1)]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), noise.draw(**KEY)[1].T)
