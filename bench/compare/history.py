"""Compares results of several versions: a chart and a table of each estimator's error and failures."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from bench.compare.cells import rows_by_cell
from bench.compare.judging import ROUNDING, Row, distance, value
from bench.compare.sources import Results, open_results
from bench.errors import UserError, local_path
from bench.experiment.columns import Column, Columns, text
from bench.experiment.views import Chart, Mark, Table, Views
from bench.experiment.words import parse_words
from bench.report.text import counted
from bench.run.files import make_directory, write_all

CHANGED = 1.01
"""Smallest factor by which an error counts as changed."""
PANELS = 16
"""Most series that are drawn."""
ERROR = Column("error", label="relative error", digits=3)
ERRORS = ("paired", "interval", "exact")
"""Comparison rules of columns that contain an error. A series is followed by the column that has a ratio in the most
cells, the first of them if several have."""
NOT_RUN = ("unsupported", "unavailable", "waiting")
"""Statuses of cells that never ran, which do not count as failures."""
LONGEST = 18
"""Largest number of characters of a result's name in the chart. The end of a longer name is shown."""


@dataclass(frozen=True, eq=False)
class History:
    """Errors and failures, one line per result, experiment and series."""

    table: pd.DataFrame
    """``result``, ``experiment``, ``series`` (an estimator, or a backend in studies without), ``column`` (the error's),
    ``error`` (geometric mean of the ratios to the first result, over the cells that are ok in all results), ``cells``
    (their number), ``moved`` (the largest distance of a cell's gradient from that of the first result, relative to its
    norm, in studies that store gradients), ``failed`` and ``of`` (all cells of the series)."""
    names: Sequence[str]


def main(words: Sequence[str]) -> int:
    """Write the history of the results named in ``words``, the oldest first. Returns 0. Raises :class:`UserError`."""
    names, settings, _ = parse_words(words, "history", {"out": "runs/history"})
    if len(names) < 2:
        raise UserError("name two results or more, the oldest first: python -m bench history DIR DIR ... [out=DIR]")
    out = local_path("out", settings["out"])
    with ExitStack() as stack:
        results = [stack.enter_context(open_results(name)) for name in names]
        history = compute_history(names, results)
    for path in write(history, out):
        print(f"  {path}")
    return 0


def compute_history(names: Sequence[str], results: Sequence[Mapping[str, Results]]) -> History:
    """Return the history of the experiments in all results. Raises :class:`UserError` if there are none."""
    shared = [name for name in results[0] if all(name in other for other in results)]
    if not shared:
        raise UserError(f"{', '.join(names)} have no experiment in common")
    lines = []
    for experiment in shared:
        tables = [rows_by_cell(result[experiment].rows) for result in results]
        columns = results[0][experiment].columns
        vectors = [column for column in columns.compared if column.comparison and column.comparison.by == "vector"]
        by = "estimator" if any(row["estimator"] for row in tables[0].values()) else "backend"
        names_of_series = dict.fromkeys(str(row[by]) for row in tables[0].values())
        for series in names_of_series:
            keys = [key for key, row in tables[0].items() if row[by] == series and row["status"] not in NOT_RUN]
            ok_in_all = [key for key in keys if all(table.get(key, {}).get("status") == "ok" for table in tables)]
            rows = [[table[key] for key in ok_in_all] for table in tables]
            column = _error_column(columns, rows)
            for name, table, own in zip(names, tables, rows, strict=True):
                mine = [table[key] for key in keys if key in table]
                error, count = _mean_ratio(column, rows[0], own)
                moved = max(
                    (distance(vector, *pair) for vector in vectors for pair in zip(rows[0], own, strict=True)),
                    default=math.nan,
                )
                failed = len(keys) - len(mine) + sum(row["status"] != "ok" for row in mine)
                shown = series if len(names_of_series) > 1 else ""
                called = column.comparison.called if column and column.comparison else ""
                lines.append((name, experiment, shown, called, error, count, moved, failed, len(keys)))
    titles = ["result", "experiment", "series", "column", "error", "cells", "moved", "failed", "of"]
    return History(pd.DataFrame(lines, columns=titles), list(names))


def _mean_ratio(column: Column | None, first: Sequence[Row], own: Sequence[Row]) -> tuple[float, int]:
    """Return the geometric mean of the error ratios of pairs of rows, and the number of pairs with a ratio."""
    if column is None:
        return math.nan, 0
    values = np.array([[value(row, column.name) for row in pair] for pair in zip(first, own, strict=True)])
    values = values.reshape(-1, 2)
    values = values[np.isfinite(values).all(axis=1) & (values > 0).all(axis=1)]
    return (float(np.exp(np.log(values[:, 1] / values[:, 0]).mean())), len(values)) if len(values) else (math.nan, 0)


def _error_column(columns: Columns, rows: Sequence[Sequence[Row]]) -> Column | None:
    """Return the column of an error that has a ratio in the most cells of all results; None if no column has any."""
    errors = [c for by in ERRORS for c in columns.compared if c.comparison and c.comparison.by == by]
    counts = [min(_mean_ratio(column, rows[0], own)[1] for own in rows) for column in errors]
    return errors[counts.index(max(counts))] if any(counts) else None


def write(history: History, out: Path) -> list[Path]:
    """Write ``history`` as .csv, .md and .png into a folder. Raises :class:`StorageError` if that fails."""
    from bench.report.draw import draw
    from bench.report.figures import save, styled
    from bench.report.writer import table_files

    make_directory(out)
    shown = views(history)
    paths = write_all(out, table_files(shown.tables, "History"))
    (chart,) = shown.charts
    with styled():
        return [*paths, *save(draw(chart), out / chart.name, data=chart.plotted())]


def views(history: History) -> Views:
    """Return the finding, the table of all series, and small multiples of the series that changed."""
    short = _short_names(history.names)
    table = history.table.assign(
        line=[": ".join(filter(None, pair)) for pair in zip(history.table["experiment"], history.table["series"], strict=True)],
        failures=[f"{f} of {n}" for f, n in zip(history.table["failed"], history.table["of"], strict=True)],
        result=history.table["result"].map(short),
    )  # fmt: skip
    changes = _changes(table)
    moved = changes[changes > 0].sort_values(ascending=False, kind="stable")
    compared = table.groupby("line")[["cells", "moved"]].max()
    blind = int(((compared["cells"] == 0) & compared["moved"].isna()).sum())
    total = counted(len(changes) - blind, "series", "series")
    what = f"in error by more than {CHANGED - 1:.0%}, in gradient or in failed cells"
    finding = f"None of {total} changed {what}."
    if len(moved):
        finding = f"{len(moved)} of {counted(len(changes), 'series', 'series')} changed {what}, most {moved.index[0]}."
    if blind:
        finding = f"{finding} " if len(moved) or blind < len(changes) else ""
        finding += f"{counted(blind, 'series', 'series')} cannot be compared: no cell has an error in all results."
    names = list(moved.index[:PANELS]) or list(changes.index[:PANELS])
    frame = pd.concat([table[table["line"] == name] for name in names], ignore_index=True)
    failures = {
        str(name): f"failed: {', '.join(map(str, part['failed']))} of {part['of'].iloc[0]}"
        for name, part in frame.groupby("line")
        if part["failed"].nunique() > 1
    }
    subtitle = "geometric mean of the ratios to the errors of the first result"
    subtitle += f", {len(names)} of {len(moved)} changed series" if len(moved) > len(names) else ""
    chart = Chart(
        "history", frame, [text("result", label="")], [ERROR], title=finding, panel="line", panel_notes=failures, height=1.2,
        marks=[Mark("", 1.0, axis="y")], subtitle=subtitle,
    )  # fmt: skip
    columns = [
        text("result"),
        text("experiment"),
        text("series"),
        replace(ERROR, label="error"),
        text("column", label="error of"),
        Column("cells", format="setting"),
        text("failures", label="failed"),
    ]
    notes = [
        "error: geometric mean of the ratios to the errors of the first result, over the cells that are ok in all results. Below 1 is better."
    ]
    if table["moved"].notna().any():
        columns.insert(-1, Column("moved", label="gradient moved"))
        notes.append(
            "gradient moved: largest distance of a cell's gradient from that of the first result, relative to its norm."
        )
    every = Table("history", table, columns, finding.rstrip("."), notes, data=history.table)
    return Views([every], [chart], headline=finding)


def _changes(table: pd.DataFrame) -> pd.Series:
    """Return how far each series moved: the logarithm of its largest factor, 0 below 1%, plus failures and gradients."""
    parts = {}
    for name, part in table.groupby("line", sort=False):
        factor = np.abs(np.log(part["error"].to_numpy(float)))
        factor = factor[np.isfinite(factor)].max(initial=0.0)
        failures = (part["failed"].max() - part["failed"].min()) / max(part["of"].max(), 1)
        moved = part["moved"].max() if part["moved"].notna().any() else 0.0
        parts[name] = (factor if factor > math.log(CHANGED) else 0.0) + failures
        parts[name] += math.log1p(moved) if moved > ROUNDING else 0.0
    return pd.Series(parts, dtype=float)


def _short_names(names: Sequence[str]) -> dict[str, str]:
    """Return the part of each name that is not common to the ends of all, such as the revision in ``REV:results/standard``."""
    parts = [re.split(r"(?=[:/])", name.rstrip("/")) for name in names]
    while all(len(part) > 1 and part[-1] == parts[0][-1] for part in parts):
        parts = [part[:-1] for part in parts]
    short = ["".join(part) for part in parts]
    return {
        name: text_ if len(text_) <= LONGEST else "..." + text_[-LONGEST:]
        for name, text_ in zip(names, short, strict=True)
    }
