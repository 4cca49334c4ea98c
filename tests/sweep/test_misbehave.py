"""A few of the bank of misbehaving plugins; ``misbehave.py`` runs as many as are asked for."""

import misbehave
import pytest


def test_the_bank_holds_every_kind_place_and_fault():
    cases = misbehave.bank()
    assert len(cases) == len({case.name for case in cases}) > 800
    chosen = misbehave.drawn(100, 0)
    assert {case.kind for case in chosen} == set(misbehave.KINDS)
    assert {case.fault for case in chosen} == {case.fault for case in cases}
    for case in cases:
        compile(case.text(), case.name, "exec")


@pytest.mark.slow
def test_each_has_its_row_or_listing_and_sound_cells_keep_their_numbers():
    assert misbehave.main(8, 1) == 0
