"""Writes the golden numbers of lines of cells.yaml, by default of all: python tests/golden/write.py LINE...

Each cell is measured twice, the second time with theta and the parameters of its scene moved by one unit in the last place.
A cell whose numbers move by more than a tenth of their tolerance is refused; the largest move is stored.
"""

import json
import sys
import tempfile
from contextlib import contextmanager
from dataclasses import fields, replace
from unittest import mock

import numpy as np
from golden_cells import (
    LINES,
    NUMBERS,
    distance,
    experiment_of,
    measure,
    measure_line,
    session_of,
)

SHARE = 0.1
"""Largest move by rounding that is stored, in units of the tolerance."""


@contextmanager
def moved_by_rounding(cell):
    """Move the scene's fractional parameters by one unit in the last place, and theta if it does not depend on them.

    Whole numbers are left, since code compares with them: a factor of 1 is no factor.
    """
    scene = type(cell.scene)
    values = {field.name: getattr(cell.scene, field.name) for field in fields(cell.scene)}
    changed = {
        name: float(np.nextafter(v, np.inf))
        for name, v in values.items()
        if isinstance(v, float) and not v.is_integer()
    }
    moved = cell.with_part("scene", replace(cell.scene, **changed))
    theta = cell.scene.theta0()
    if not np.array_equal(moved.scene.theta0(), theta):
        yield moved
        return
    with mock.patch.object(scene, "theta0", return_value=theta + np.spacing(np.maximum(np.abs(theta), 1.0))):
        yield moved


def rounding(line, numbers):
    """Return by cell the largest move of its numbers by rounding, in units of their tolerance."""
    experiment, cells = experiment_of(line)
    result = {}
    for name, stored in numbers.items():
        with tempfile.TemporaryDirectory() as folder, moved_by_rounding(cells[name]) as cell:
            again = measure(cell, session_of(experiment, folder))
        moves = {c: distance(c, v, again.get(c, [])) for c, v in stored.items()}
        worst = max(moves, key=moves.__getitem__)
        print(f"{name}: rounding moves {worst} by {moves[worst]:.1e} of its tolerance", flush=True)
        result[name] = moves[worst]
    return result


def main(lines):
    """Write the numbers of lines; exits with a message at a line with a cell whose rounding grows."""
    table = json.loads(NUMBERS.read_text())
    table = {name: entry for name, entry in table.items() if name.partition(":")[0] in LINES}
    for line in lines or LINES:
        numbers = measure_line(line)
        moves = rounding(line, numbers)
        if grown := [name for name, move in moves.items() if move > SHARE]:
            sys.exit(f"rounding grows in {'; '.join(grown)}: shorten the cells")
        table = {name: entry for name, entry in table.items() if name.partition(":")[0] != line}
        table |= {name: {"rounding": shortened(moves[name]), "numbers": shortened(numbers[name])} for name in numbers}
        rows = [f"{json.dumps(name)}: {json.dumps(table[name])}" for name in sorted(table)]
        NUMBERS.write_text("{\n" + ",\n".join(rows) + "\n}\n")


def shortened(value):
    """Return a value with its numbers to twelve digits."""
    if isinstance(value, dict):
        return {name: shortened(v) for name, v in value.items()}
    if isinstance(value, list | tuple):
        return [shortened(v) for v in value]
    return value if isinstance(value, str) else float(f"{value:.12g}")


if __name__ == "__main__":
    main(sys.argv[1:])
