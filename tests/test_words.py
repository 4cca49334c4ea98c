"""The check of the word list counts what CONTRIBUTING.md bans, and fails above a ceiling."""

import importlib
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()
PLANTED = '''"""Say what is told here; ``told`` in code counts for nothing, nor does ``held to``."""


def found(asked):
    """Return what a record\\n    tells of it."""
    said = "told"
    return f"{said} is no number, {asked} is no longer one, both are alike"
'''


@pytest.fixture(scope="module")
def words():
    """The module ``tests/programs/words.py``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "tests" / "programs")
        return importlib.import_module("words")


def test_each_banned_word_is_counted_once(words, tmp_path):
    (tmp_path / "planted.py").write_text(PLANTED)
    places = words.violations([tmp_path / "planted.py"], CONTRIBUTING)
    counts = {rule: len(lines) for rule, lines in places.items() if lines}
    phrases = {"told": 1, "tells": 1, "record tells": 1, "is no WORD": 1, "alike": 1}
    assert counts == phrases | {"name: found": 1, "name: asked": 1, "name: said": 1}
    assert places["alike"] == [(tmp_path / "planted.py", 7)]


def test_each_row_of_the_tables_is_a_rule_or_has_no_backticks(words):
    phrases, names = words.rules(CONTRIBUTING)
    assert {"told", "worse than answering", "letters", "is no WORD", "thereby"} <= set(phrases)
    assert {"found", "told", "said"} <= names


def test_ceilings_are_those_of_rules(words):
    phrases, names = words.rules(CONTRIBUTING)
    assert set(json.loads(words.CEILINGS.read_text())) <= {*phrases, *(f"name: {name}" for name in names)}


def test_a_count_above_its_ceiling_fails_and_ceilings_only_fall(words, tmp_path, monkeypatch, capsys):
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench" / "planted.py").write_text(PLANTED)
    (tmp_path / "CONTRIBUTING.md").write_text(CONTRIBUTING)
    ceilings = {"told": 3, "tells": 1, "record tells": 1, "is no WORD": 0, "alike": 1}
    ceilings |= {"name: found": 1, "name: asked": 1, "name: said": 1}
    (tmp_path / "words.json").write_text(json.dumps(ceilings))
    monkeypatch.setattr(words, "ROOT", tmp_path)
    monkeypatch.setattr(words, "CEILINGS", tmp_path / "words.json")
    assert words.main(["--lower"]) == 1
    assert "'is no WORD' 1 times, the ceiling is 0" in capsys.readouterr().out
    lowered = json.loads((tmp_path / "words.json").read_text())
    assert lowered == {rule: 1 for rule in ceilings if rule != "is no WORD"}
    (tmp_path / "words.json").write_text(json.dumps(lowered | {"is no WORD": 1}))
    assert words.main([]) == 0
