"""The examples on foreign simulators: short, and each ends in a report; what that finds is its own affair.

Those whose libraries are missing are skipped; `make examples` builds an environment that has them all.
"""

import importlib.util
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted(path for path in (ROOT / "examples").glob("*.py") if path.stem != "table")
LIMIT = 1800
"""Seconds; compilations have budgets of their own, and Brax has three engines."""
SHORT = """
import runpy, sys
import bench

whole = bench.examine
bench.examine = lambda *given, **settings: whole(*given, **settings | {"budget": "10s"})
del sys.argv[0]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Runs an example with a small budget: that it ends in a report does not depend on how sharp the report is."""
ENDS = ("Derivative: ",)


def libraries(text):
    """Modules that an example imports, by their first names."""
    return set(re.findall(r"^\s*(?:import|from) (\w+)", text, re.MULTILINE))


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_ends_in_a_report(path):
    missing = [name for name in sorted(libraries(path.read_text())) if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", SHORT, str(path)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=LIMIT)
    assert done.returncode == 0, done.stderr
    assert any(line.startswith(ENDS) for line in done.stdout.splitlines()), done.stdout


def test_the_page_has_the_stored_table_of_all_examples():
    table = runpy.run_path(str(ROOT / "examples" / "table.py"))
    assert sorted(table["ORDER"]) == [path.stem for path in EXAMPLES]
    stored = table["stored"]()
    assert list(stored) == list(table["ORDER"])
    assert all(len(row) == len(table["HEAD"]) for rows in stored.values() for row in rows)
    page = (ROOT / "docs/examine.md").read_text()
    assert page.partition(table["BEGIN"])[2].partition(table["END"])[0] == table["as_text"](stored)


@pytest.mark.skipif(importlib.util.find_spec("pydrake") is not None, reason="needs an environment without Drake")
def test_an_example_without_its_library_has_no_rows_and_names_it():
    table = runpy.run_path(str(ROOT / "examples" / "table.py"))
    assert table["rows"]("drake_ball") == ([], "not installed: pydrake")
