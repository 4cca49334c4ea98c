"""The planted faults: each is in the code as it is, and a list that has gone stale is told before anything runs."""

import mutants
import pytest
from mutants import FAULTS, ROOT, Fault


def test_every_fault_can_be_planted_exactly_once():
    assert not mutants.stale(FAULTS)


def test_every_fault_changes_its_text_and_names_tests_that_exist():
    for fault in FAULTS:
        assert fault.new != fault.old
        files = [word.split("::")[0] for word in fault.tests.split() if word.startswith("tests/")]
        assert files
        assert all((ROOT / name).is_file() for name in files), fault.tests


@pytest.mark.parametrize("old", ["text that is nowhere", "import"])
def test_a_stale_fault_ends_the_run_and_is_named(monkeypatch, old):
    """One whose text is gone would count as killed, or as survived; one found twice would be planted anywhere."""
    monkeypatch.setattr(mutants, "FAULTS", [*FAULTS[:2], Fault(FAULTS[0].path, old, "", "tests/none.py")])
    with pytest.raises(SystemExit, match=f"{FAULTS[0].path} does not hold exactly one: {old}"):
        mutants.main([])
