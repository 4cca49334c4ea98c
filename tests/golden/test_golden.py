"""Golden cells come out again, and together they use every built-in plugin."""

import json
from functools import cache

import pytest
from golden_cells import (
    LINES,
    NUMBERS,
    TABLE,
    WRITE,
    experiment_of,
    measure_line,
    moved_columns,
    plugins_of,
    sentence,
    suspects,
)

from bench.engines.backend import EngineBackend
from bench.model import registry

STORED = json.loads(NUMBERS.read_text())
TOGETHER = {"scenes callable", "backends callable"}
"""Plugins that only run with each other, so that no cell tells them apart."""


@cache
def moved_cells(line):
    """Return the columns that moved, by cell; cells whose libraries are not installed are left out."""
    return {name: moved_columns(STORED[name]["numbers"], numbers) for name, numbers in measure_line(line).items()}


def explain(lines):
    columns = {name: moved for line in lines for name, moved in moved_cells(line).items()}
    plugins = {name: plugins_of(experiment_of(line)[1][name]) for line in lines for name in moved_cells(line)}
    moved = {name for name, some in columns.items() if some}
    return "\n".join(sentence(*found, columns) for found in suspects(moved, plugins))


@pytest.mark.parametrize(
    "line", [*TABLE["fast"], *(pytest.param(name, marks=pytest.mark.slow) for name in TABLE["slow"])]
)
def test_golden_numbers_come_out_again(line):
    stored = {name for name in STORED if name.startswith(f"{line}:")}
    assert stored == set(experiment_of(line)[1]), f"the line has other cells: write it again, {WRITE} {line}"
    moved = moved_cells(line)
    if not moved:
        pytest.skip("the libraries of its plugins are not installed")
    if any(moved.values()):
        pytest.fail(explain(list(TABLE["fast"] if line in TABLE["fast"] else LINES)))


@pytest.mark.slow
def test_every_built_in_plugin_is_in_a_golden_cell_and_named_when_its_numbers_move():
    plugins = {name: plugins_of(cell) for line in LINES for name, cell in experiment_of(line)[1].items()}
    for kind, entries in registry.entries().items():
        for name, entry in entries.items():
            plugin = entry.plugin
            if not plugin.__module__.startswith("bench.") or issubclass(plugin, EngineBackend):
                continue
            moved = {cell for cell, classes in plugins.items() if plugin in classes}
            assert moved, f"add a line for {name} of {kind} to tests/golden/cells.yaml and write its numbers"
            ((named, _),) = suspects(moved, plugins)
            if f"{kind} {name}" not in TOGETHER:
                assert named == [plugin], f"add a cell with just one of {[cls.__name__ for cls in named]}"
