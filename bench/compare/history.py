"""Compares results of several versions: a chart and a table of each estimator's error and failures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from bench.compare.cells import rows_by_cell
from bench.compare.sources import Results, open_results
from bench.errors import UserError
from bench.experiment.columns import Column, Columns
from bench.experiment.words import parse_words
from bench.report.colours import estimator_order
from bench.report.tables import plain_markdown
from bench.report.text import number
from bench.run.files import make_directory, write_all

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 7.16, 2.4
"""Size of the chart [inches]."""
ERRORS = ("paired", "interval", "exact")
"""Comparison rules of columns that contain an error. The history uses the first such column of a study."""
NOT_RUN = ("unsupported", "unavailable")
"""Statuses of cells that never ran, which do not count as failures."""
LONGEST = 18
"""Largest number of characters of a result's name in the chart. The end of a longer name is shown."""


@dataclass(frozen=True, eq=False)
class History:
    """Errors and failures, one line per result, experiment and series."""

    table: pd.DataFrame
    """``result``, ``experiment``, ``series``, ``error`` (geometric mean of the ratios to the first result, over the cells
    that are ok in all results), ``cells`` (their number), ``failed`` and ``of`` (all cells of the series)."""
    names: Sequence[str]


def main(words: Sequence[str]) -> int:
    """Write the history of the results named in ``words``, the oldest first. Returns 0. Raises :class:`UserError`."""
    names, settings, _ = parse_words(words, "history", {"out": "runs/history"})
    if len(names) < 2:
        raise UserError("name two results or more, the oldest first: python -m bench history DIR DIR ... [out=DIR]")
    with ExitStack() as stack:
        results = [stack.enter_context(open_results(name)) for name in names]
        history = compute_history(names, results)
    for path in write(history, Path(settings["out"]).expanduser()):
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
        first = list(tables[0].values())
        estimators = dict.fromkeys(str(row["estimator"]) for row in first)
        for series in estimators:
            keys = [
                key for key, row in tables[0].items() if row["estimator"] == series and row["status"] not in NOT_RUN
            ]
            ok_in_all = [key for key in keys if all(table.get(key, {}).get("status") == "ok" for table in tables)]
            for name, table in zip(names, tables, strict=True):
                mine = [table[key] for key in keys if key in table]
                error, count = _mean_ratio(columns, [(tables[0][key], table[key]) for key in ok_in_all])
                failed = len(keys) - len(mine) + sum(row["status"] != "ok" for row in mine)
                lines.append((name, experiment, series if len(estimators) > 1 else "", error, count, failed, len(keys)))
    titles = ["result", "experiment", "series", "error", "cells", "failed", "of"]
    return History(pd.DataFrame(lines, columns=titles), list(names))


def _mean_ratio(
    columns: Columns, pairs: Sequence[tuple[Mapping[str, object], Mapping[str, object]]]
) -> tuple[float, int]:
    """Return the geometric mean of the error ratios of pairs of rows, and the number of pairs with a ratio."""
    column = _error_column(columns)
    if column is None:
        return math.nan, 0
    values = np.array([[float(str(row.get(column.name, "nan"))) for row in pair] for pair in pairs]).reshape(-1, 2)
    values = values[np.isfinite(values).all(axis=1) & (values > 0).all(axis=1)]
    return (float(np.exp(np.log(values[:, 1] / values[:, 0]).mean())), len(values)) if len(values) else (math.nan, 0)


def _error_column(columns: Columns) -> Column | None:
    return next((c for by in ERRORS for c in columns.compared if c.comparison and c.comparison.by == by), None)


def write(history: History, out: Path) -> list[Path]:
    """Write ``history`` as .csv, .md and .png into a folder. Raises :class:`StorageError` if that fails."""
    from bench.report.figures import save, styled

    make_directory(out)
    readable = history.table.assign(
        error=[number(e, 3) for e in history.table["error"]],
        failed=[f"{f} of {n}" for f, n in zip(history.table["failed"], history.table["of"], strict=True)],
    ).drop(columns="of")
    text = (
        "# History\n\n`error` is the geometric mean of the ratios to the errors of the first result, over the cells that are ok "
        f"in all results. Below 1 is better.\n\n{plain_markdown(readable.astype(str))}\n"
    )
    paths = write_all(out, {"history.csv": history.table.to_csv(index=False, lineterminator="\n"), "history.md": text})
    with styled():
        return [*paths, *save(figure(history), out / "history")]


def figure(history: History) -> Figure:
    """Draw the errors relative to the first result, and the share of failed cells."""
    from matplotlib.figure import Figure

    from bench.report.scales import log_axis
    from bench.report.style import MARKERS, colour

    known = estimator_order()
    drawn = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    left, right = drawn.subplots(1, 2)
    places = np.arange(len(history.names))
    several = history.table["experiment"].nunique() > 1
    ratios = history.table["error"].dropna()
    lines = list(history.table.groupby(["experiment", "series"], sort=False))
    for turn, ((experiment, series), part) in enumerate(lines):
        place = known.index(series) if series in known else len(known) + turn
        label = ": ".join(filter(None, [experiment if several else "", series])) or experiment
        look = {"color": colour(place), "marker": MARKERS[(place + place // 8) % len(MARKERS)], "label": label}
        if part["error"].notna().any():
            left.plot(places, part["error"], **look)
        right.plot(places, part["failed"] / part["of"] * 100, **look)
    low, high = (min([0.8, *ratios]) / 1.05, max([1.25, *ratios]) * 1.05)
    log_axis(left, "y", low, high)
    left.axhline(1.0, color="#595959", linewidth=0.9, linestyle=(0, (3, 2)), zorder=1)
    left.set_title("Error, relative to the first result")
    right.set_title("Failed cells [%]")
    right.set_ylim(bottom=-2 if history.table["failed"].max() else -0.1)
    for panel in (left, right):
        panel.set_xticks(places, [_shorten(name) for name in history.names], rotation=20, ha="right")
        panel.set_xlim(-0.2, len(places) - 0.8)
    if len(lines) > 1:
        handles, labels = right.get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside lower center", ncols=4)
    return drawn


def _shorten(name: str) -> str:
    name = name.rstrip("/")
    return name if len(name) <= LONGEST else "..." + name[-LONGEST:]
