"""The examples are short, and each ends in a report. Those whose libraries are missing are skipped."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
LIMIT = 1800
"""Seconds; compilations have budgets of their own."""
SHORT = """
import runpy, sys
import bench

whole = bench.examine
bench.examine = lambda *given, **settings: whole(*given, **settings | {"budget": "10s"})
del sys.argv[0]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Runs an example with a small budget: that it ends in a report does not depend on how sharp the report is."""
ENDS = ("Derivative: ", "iterations checked")


def libraries(text):
    """Modules that an example imports, by their first names."""
    return set(re.findall(r"^\s*(?:import|from) (\w+)", text, re.MULTILINE))


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_ends_in_a_report(path, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(path.parent)
    missing = [name for name in sorted(libraries(path.read_text())) if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(path.parent)])}
    words = [sys.executable, "-c", SHORT, str(path)]
    done = subprocess.run(words, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=LIMIT)
    assert done.returncode == 0, done.stderr
    assert any(end in done.stdout for end in ENDS), done.stdout
