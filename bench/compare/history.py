"""Compares results of several versions: a chart and a table of each estimator's error and failures."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from bench.compare.cells import rows_by_cell
from bench.compare.judging import ROUNDING, distance, rule_of
from bench.compare.sources import Results, read_results
from bench.errors import UserError, local_path
from bench.experiment.columns import Column, setting, text
from bench.experiment.views import Chart, Mark, Table, Views
from bench.experiment.words import parse_words
from bench.report.views import attempted
from bench.run.files import make_directory, write_all

ERROR = Column("error", label="relative error", digits=3)
QUESTION = "Which series changed?"
NOTES = (
    "error: geometric mean of the ratios to the errors of the first result, over the cells that are ok in all results. Below "
    "1 is better.",
    "gradient moved: largest distance of a cell's gradient from that of the first result, relative to its norm.",
)


def main(words: Sequence[str]) -> int:
    """Write the history of the results named in ``words``, the oldest first. Returns 0. Raises :class:`UserError`."""
    names, settings, _ = parse_words(words, "history", {"out": "runs/history"})
    if len(names) < 2:
        raise UserError("name two results or more, the oldest first: python -m bench history DIR DIR ... [out=DIR]")
    out = local_path("out", settings["out"])
    print("Written:", *write(compute_history(names, [*map(read_results, names)]), out), sep="\n  ")
    return 0


def compute_history(names: Sequence[str], results: Sequence[Mapping[str, Results]]) -> pd.DataFrame:
    """Return errors and failures, a line per result, experiment and series. Raises :class:`UserError` without a common experiment.

    Columns: ``result``, ``experiment``, ``series`` (an estimator, or a backend in studies without), ``column`` (the error's),
    ``error`` (geometric mean of the ratios to the first result, over the cells that are ok in all results), ``cells``
    (their number), ``moved`` (the largest distance of a cell's gradient from that of the first result, relative to its
    norm, in studies that store gradients), ``failed`` and ``of`` (all cells of the series).
    """
    shared = [name for name in results[0] if all(name in other for other in results)]
    if not shared:
        raise UserError(f"{', '.join(names)} have no experiment in common")
    lines = []
    for experiment in shared:
        tables = [rows_by_cell(result[experiment].rows) for result in results]
        first, compared = tables[0], results[0][experiment].columns.compared
        tables = [table.reindex(first.index) for table in tables]
        is_ok = pd.concat([table["status"] == "ok" for table in tables], axis=1, keys=range(len(tables)))
        by = "estimator" if first["estimator"].any() else "backend"
        # an experiment is followed by the first column of an error that has a value
        rules = ("paired", "interval", "exact")
        errors = [column for rule in rules for column in compared if rule_of(column).by == rule]
        error = next((column for column in errors if (first[column.name] > 0).any()), None)
        vectors = [column for column in compared if rule_of(column).by == "vector"]
        for series, every in first.groupby(by, sort=False):
            # cells that never ran are no failures
            of = attempted(every).index
            same = of[is_ok.loc[of].all(axis=1)]
            before = first.loc[same]
            for place, (name, table) in enumerate(zip(names, tables, strict=True)):
                after = table.loc[same]
                logs = _log_ratios(before[error.name], after[error.name]) if error else np.empty(0)
                pairs = [*zip(before.to_dict("records"), after.to_dict("records"), strict=True)]
                moves = [distance(column, *pair) for column in vectors for pair in pairs]
                lines.append(
                    {
                        "result": name,
                        "experiment": experiment,
                        "series": series if first[by].nunique() > 1 else "",
                        "column": rule_of(error).called if error else "",
                        "error": float(np.exp(logs.mean())) if len(logs) else math.nan,
                        "cells": len(logs),
                        "moved": max(moves, default=math.nan),
                        "failed": int((~is_ok.loc[of, place]).sum()),
                        "of": len(of),
                    }
                )
    return pd.DataFrame(lines)


def _log_ratios(was: pd.Series, now: pd.Series) -> np.ndarray:
    """Return the logarithms of the ratios of the values that both have."""
    values = pd.concat([was, now], axis=1).to_numpy(float)
    values = values[(np.isfinite(values) & (values > 0)).all(axis=1)]
    return np.asarray(np.log(values[:, 1] / values[:, 0]))


def write(history: pd.DataFrame, out: Path) -> list[Path]:
    """Write the history as .csv, .md and .png into a folder. Raises :class:`StorageError` if that fails."""
    from bench.report.draw import draw
    from bench.report.figures import save, styled
    from bench.report.writer import table_files

    make_directory(out)
    shown = views(history)
    paths = write_all(out, table_files(shown.tables, "History"))
    (chart,) = shown.charts
    with styled():
        return [*paths, *save(draw(chart), out / chart.name, data=chart.plotted())]


def views(history: pd.DataFrame) -> Views:
    """Return the table of all series, and small multiples of the series that changed."""
    table = history.assign(
        line=[": ".join(filter(None, pair)) for pair in zip(history["experiment"], history["series"], strict=True)],
        failures=[f"{f} of {n}" for f, n in zip(history["failed"], history["of"], strict=True)],
        result=history["result"].map(_short_names(history["result"].unique())),
    )
    parts = dict(iter(table.groupby("line", sort=False)))
    moved = [name for name, part in parts.items() if _is_changed(part)]
    frame = pd.concat([parts[name] for name in (moved or [*parts])[:16]], ignore_index=True)
    failures = {
        str(name): f"failed: {', '.join(map(str, part['failed']))} of {part['of'].iloc[0]}"
        for name, part in frame.groupby("line")
        if part["failed"].nunique() > 1
    }
    chart = Chart(
        "history",
        frame,
        [text("result", label="")],
        [ERROR],
        title=QUESTION,
        panel="line",
        panel_notes=failures,
        height=1.2,
        marks=[Mark("", 1.0, axis="y")],
        subtitle=f"{len(moved)} of {len(parts)} series changed",
    )
    columns = [
        text("result"),
        text("experiment"),
        text("series"),
        replace(ERROR, label="error"),
        text("column", label="error of"),
        setting("cells"),
        Column("moved", label="gradient moved"),
        text("failures", label="failed"),
    ]
    return Views([Table("history", table, columns, QUESTION, NOTES, data=history)], [chart])


def _is_changed(part: pd.DataFrame) -> bool:
    """Return whether an error of a series moved by 1%, or its failures or gradients changed."""
    error = part["error"].max() / part["error"].min()
    return bool(error > 1.01 or part["failed"].nunique() > 1 or (part["moved"] > ROUNDING).any())


def _short_names(names: Iterable[str]) -> dict[str, str]:
    """Return the part of each name before the end that all have, such as the revision in ``REV:results/standard``."""
    parts = [re.split(r"(?=[:/])", name.rstrip("/")) for name in names]
    while all(len(part) > 1 and part[-1] == parts[0][-1] for part in parts):
        parts = [part[:-1] for part in parts]
    return {name: "".join(part)[-18:] for name, part in zip(names, parts, strict=True)}
