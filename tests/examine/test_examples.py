"""The examples on foreign simulators: short, and each ends in a report; what that finds is its own affair."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
MOST_LINES = 40
ENDS = ("RIGHT: ", "CANNOT BE TRUSTED: ")


def libraries(text):
    """Modules that an example imports, by their first names."""
    return set(re.findall(r"^\s*(?:import|from) (\w+)", text, re.MULTILINE))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_says_what_it_is(path):
    text = path.read_text()
    assert len(text.splitlines()) <= MOST_LINES
    assert text.startswith('"""')
    assert "examine(" in text


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_ends_in_a_report(path):
    missing = [name for name in sorted(libraries(path.read_text())) if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, str(path), *(["mujoco"] if "sys.argv" in path.read_text() else [])]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr
    assert any(line.startswith(ENDS) for line in done.stdout.splitlines()), done.stdout
