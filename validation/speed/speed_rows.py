"""Rows of the speed table: measured number and target, and the file that they are written to."""

import json
import math
from dataclasses import asdict, dataclass

from bench.run.files import make_directory, write_all
from bench.run.record import machine


@dataclass(frozen=True)
class SpeedRow:
    """One measured number, which should be at most ``target`` (NaN for no target)."""

    what: str
    value: float
    unit: str
    target: float = math.nan
    spread: float = math.nan
    """Interquartile range of the timed calls divided by their median."""
    note: str = ""

    @property
    def ratio(self):
        """Value over target."""
        return self.value / self.target


def write(rows, directory, load_before):
    """Write ``bench_self.json``. Returns its path."""
    make_directory(directory)
    lines = [
        {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in line.items()}
        for line in (asdict(row) | {"ratio": row.ratio} for row in rows)
    ]
    record = {"machine": machine(), "load_average_before": load_before, "lines": lines}
    (path,) = write_all(directory, {"bench_self.json": json.dumps(record, indent=1) + "\n"})
    return path
