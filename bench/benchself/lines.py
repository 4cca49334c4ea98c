"""Lines of the table: measured number, target, and the files they are written to."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench.report.tables import plain_markdown
from bench.run.files import make_directory, write_all
from bench.run.record import machine


@dataclass(frozen=True)
class SpeedRow:
    """One measured number: at most ``target`` is wanted, NaN for no target."""

    what: str
    value: float
    unit: str
    target: float = math.nan
    spread: float = math.nan
    """Interquartile range over median of the timed calls."""
    note: str = ""

    @property
    def ratio(self) -> float:
        """Value over target."""
        return self.value / self.target


def texts(lines: Sequence[SpeedRow]) -> list[dict[str, str]]:
    """Return the lines as they are printed."""
    return [
        {
            "what": line.what,
            "measured": _number(line.value),
            "unit": line.unit,
            "target": _number(line.target),
            "ratio": _number(line.ratio),
            "spread": "" if math.isnan(line.spread) else f"{line.spread:.0%}",
            "note": line.note,
        }
        for line in lines
    ]


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3g}" if abs(value) < 1e4 else f"{value:.0f}"


def show(lines: Sequence[SpeedRow]) -> None:
    """Print the table."""
    from rich.console import Console
    from rich.table import Table

    rows = texts(lines)
    table = Table(*rows[0], title="bench-self")
    for row in rows:
        table.add_row(*row.values())
    Console(width=130).print(table)


def write(lines: Sequence[SpeedRow], directory: Path, load_before: list[float] | None) -> list[Path]:
    """Write ``bench_self`` as .csv, .md and .json; returns their paths."""
    import pandas as pd

    make_directory(directory)
    table = pd.DataFrame([{**asdict(line), "ratio": line.ratio} for line in lines])
    record: dict[str, Any] = {
        "machine": machine(), "load_average_before": load_before, "lines": json.loads(table.to_json(orient="records")),
    }  # fmt: skip
    contents = {
        "bench_self.csv": table.to_csv(index=False, lineterminator="\n"),
        "bench_self.md": "# bench-self\n\n" + plain_markdown(pd.DataFrame(texts(lines))) + "\n",
        "bench_self.json": json.dumps(record, indent=1) + "\n",
    }
    return write_all(directory, contents)
