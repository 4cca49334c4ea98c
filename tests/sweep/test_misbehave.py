"""The bank of misbehaving plugins is whole; ``misbehave.py`` runs as many of them as are asked for."""

import misbehave


def test_the_bank_holds_every_kind_place_and_fault():
    cases = misbehave.bank()
    assert len(cases) == len({case.name for case in cases}) > 800
    chosen = misbehave.drawn(100, 0)
    assert {case.kind for case in chosen} == set(misbehave.KINDS)
    assert {case.fault for case in chosen} == {case.fault for case in cases}
    for case in cases:
        compile(case.text(), case.name, "exec")
