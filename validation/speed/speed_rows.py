"""Rows of the speed table: measured number and target, and the files that they are written to."""

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
    """One measured number, which should be at most ``target`` (NaN for no target)."""

    what: str
    value: float
    unit: str
    target: float = math.nan
    spread: float = math.nan
    """Interquartile range of the timed calls divided by their median."""
    note: str = ""

    @property
    def ratio(self) -> float:
        """Value over target."""
        return self.value / self.target


def format_rows(rows: Sequence[SpeedRow]) -> list[dict[str, str]]:
    """Return the rows as printed, each as strings by column."""
    return [
        {
            "what": row.what,
            "measured": _number(row.value),
            "unit": row.unit,
            "target": _number(row.target),
            "ratio": _number(row.ratio),
            "spread": "" if math.isnan(row.spread) else f"{row.spread:.0%}",
            "note": row.note,
        }
        for row in rows
    ]


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3g}" if abs(value) < 1e4 else f"{value:.0f}"


def show(rows: Sequence[SpeedRow]) -> None:
    """Print the table."""
    import pandas as pd

    from bench.report import terminal

    formatted = pd.DataFrame(format_rows(rows))
    terminal.print_table(
        terminal.open_console(), formatted, title="bench-self", right=("measured", "target", "ratio", "spread")
    )


def write(rows: Sequence[SpeedRow], directory: Path, load_before: list[float] | None) -> list[Path]:
    """Write ``bench_self`` as .csv, .md and .json. Returns their paths."""
    import pandas as pd

    make_directory(directory)
    table = pd.DataFrame([{**asdict(row), "ratio": row.ratio} for row in rows])
    record: dict[str, Any] = {
        "machine": machine(), "load_average_before": load_before, "lines": json.loads(table.to_json(orient="records")),
    }  # fmt: skip
    contents = {
        "bench_self.csv": table.to_csv(index=False, lineterminator="\n"),
        "bench_self.md": "# bench-self\n\n" + plain_markdown(pd.DataFrame(format_rows(rows))) + "\n",
        "bench_self.json": json.dumps(record, indent=1) + "\n",
    }
    return write_all(directory, contents)
