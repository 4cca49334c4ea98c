"""Golden cells: how they are composed, measured and compared, and which plugins explain those whose numbers moved."""

import inspect
import json
import math
import tempfile
from collections import defaultdict
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from bench.experiment import config, grid
from bench.host.identity import label, parse_identity
from bench.model import registry
from bench.run.session import RunSession
from bench.run.tasks import measure_cell

FOLDER = Path(__file__).parent
TABLE = yaml.safe_load((FOLDER / "cells.yaml").read_text())
LINES = TABLE["fast"] | TABLE["slow"]
NUMBERS = FOLDER / "numbers.json"
"""By cell: its numbers, and how far they move by rounding, in units of their tolerance."""
WRITE = "python tests/golden/write.py"

TOLERANCE, LEAST = 1e-8, 1e-10
"""Allowed difference, relative to the largest number of a column, and its least size, since errors of exact gradients are
rounding. Tests compile without optimisation, and machines differ in vector units and BLAS, which changes the last one or
two of 16 digits; differences of costs over 1e-6 lose six more. The writer refuses a cell whose rounding grows to a tenth."""
DIFFERENCES = {
    **dict.fromkeys(("program_error", "program_error_rel", "best_error", "check_error", "taylor_order"), (1e-3, 1e-5)),
    **dict.fromkeys(("relative_error", "derivative_differences", "component_uncertainty"), (1e-2, 1e-4)),
}
"""The two numbers for columns that are mostly rounding: errors of the best differences of costs, and of those over every step."""
UNCOMPARED = frozenset(
    (
        "reason",
        "command",
        "device",
        "engine_settings",
        "hypotheses",
        "optimum_status",
        "contradictions",
        "best_eps",
        "mode_minus",
        "mode_plus",
        "check_eps",
        "component_step",
        "difference_step",
    )
)
"""Columns of wording or of the machine, step sizes that rounding chooses among equally good ones, and contacts at those."""


@cache
def experiment_of(line):
    """Return the experiment of a line of the table, and its cells by line and identity strings."""
    words = LINES[line].split()
    study = next((word.partition("=")[2] for word in words if word.startswith("study=")), "bias_variance")
    axes = registry.usable("studies", parse_identity(study)[0]).axes  # type: ignore[attr-defined]
    common = [word for word in TABLE["common"].split() if "estimator" in axes or not word.startswith("estimators=")]
    experiment = config.load([*common, *words])
    return experiment, {f"{line}: {name_of(cell)}": cell for cell in grid.cells(experiment)}


def name_of(cell):
    """Return the identity strings of a cell's plugins."""
    return " ".join(label(part) for part in (cell.study, *cell.parts.values()) if part is not None)


def session_of(experiment, folder):
    """Return a session that finds no references computed earlier."""
    return RunSession(replace(experiment, results_dir=Path(folder)))


def measure_line(line):
    """Return the numbers of a line's cells by name, without cells whose libraries are not installed."""
    experiment, cells = experiment_of(line)
    with tempfile.TemporaryDirectory() as folder:
        session = session_of(experiment, folder)
        return {name: measure(cell, session) for name, cell in cells.items() if is_installed(cell)}


def is_installed(cell):
    """Return whether the libraries of a cell's plugins are installed."""
    refusal = cell.refusal()
    return refusal is None or refusal[0] != "unavailable"


def measure(cell, session):
    """Return the columns of a cell that its plugins and counts decide."""
    columns = cell.study.columns.by_name  # type: ignore[attr-defined]
    result = measure_cell(replace(cell, timing=False), session, cell.study)  # type: ignore[arg-type]
    if result["status"] in ("error", "unsupported"):
        raise RuntimeError(f"{name_of(cell)}: {result['reason']}")
    kept = {name: value for name, value in result.items() if name not in UNCOMPARED and value is not None}
    return {name: parsed(name, value) for name, value in kept.items() if not columns[name].measured}


def parsed(name, value):
    """Return a value, with the table of diagnostics as a list of its numbers."""
    if name != "auxiliaries":
        return value
    return [number for row in json.loads(value or "{}").values() for number in row.values()]


def distance(name, first, second):
    """Return the difference of two values of a column in units of what is allowed; infinite where words or gaps differ."""
    a, b = (np.atleast_1d(np.array(value)) for value in (first, second))
    if a.shape != b.shape:
        return math.inf
    if "U" in a.dtype.kind + b.dtype.kind:
        return 0.0 if (a == b).all() else math.inf
    finite = np.isfinite(a)
    if not np.array_equal(a[~finite], b[~finite], equal_nan=True):
        return math.inf
    relative, least = DIFFERENCES.get(name, (TOLERANCE, LEAST))
    sizes, changes = np.abs(a[finite]), np.abs(a[finite] - b[finite])
    return float(changes.max() / (relative * sizes.max() + least)) if finite.any() else 0.0


def moved_columns(stored, measured, allowed=1.0):
    """Return the columns of which only one has a value, or whose values differ by more than ``allowed`` tolerances."""
    columns = stored.keys() | measured.keys()
    return sorted(c for c in columns if not distance(c, stored.get(c, []), measured.get(c, [])) <= allowed)


def plugins_of(cell):
    """Return the classes of a cell's plugins, with its study and the policy of its scene."""
    plugins = {type(part) for part in (*cell.parts.values(), cell.study) if part is not None}
    policy = getattr(cell.scene, "policy", None)
    return plugins | ({registry.usable("policies", parse_identity(policy)[0])} if policy else set())


def suspects(moved, plugins):
    """Return the fewest classes that explain the cells that moved, each with those cells; classes that explain as much are one list.

    A class explains cells if no cell that uses it, or none that uses it or a class derived from it, came out equal.
    """
    users = defaultdict(set)
    for name, classes in plugins.items():
        for plugin in classes:
            users[True, plugin].add(name)
            for base in plugin.__mro__:
                users[False, base].add(name)
    possible = {key: names for key, names in users.items() if names <= set(moved)}
    result, left = [], set(moved)
    while explained := max((names & left for names in possible.values()), key=len, default=set()):
        keys = [key for key, names in possible.items() if names & left == explained]
        itself = max(is_itself for is_itself, _ in keys)
        result.append(([cls for is_itself, cls in keys if is_itself == itself], explained))
        left -= explained
    return result + ([([], left)] if left else [])


def sentence(classes, cells, columns):
    """Return what moved, in which cells and columns, and the lines to change if that is intended."""
    some = "; ".join(f"{cell}: {', '.join(columns[cell][:4])}" for cell in sorted(cells)[:3])
    who = " or ".join(sorted(cls.__name__ for cls in classes)) or "what several plugins share"
    files = [f"{cls.__name__} in {Path(inspect.getfile(cls)).relative_to(FOLDER.parents[1])}" for cls in classes]
    lines = sorted({cell.partition(":")[0] for cell in cells})
    return (
        f"{who} moved ({len(cells)} cells, such as {some}). If this is intended, raise `revision` of "
        f"{' or '.join(files) or 'the code that moved'} and write the golden numbers again: {WRITE} {' '.join(lines)}"
    )
