"""Writes the output files from stored rows, tables, charts, the record of the run and the page, and prints a summary."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pandas as pd

from bench.errors import UserError, printable, unknown
from bench.experiment.experiment import Experiment
from bench.experiment.views import Views
from bench.host import guard
from bench.report import answer, generic, ladder, reproduce, writer
from bench.report.views import newest_rows
from bench.report.web.data import page_data
from bench.report.web.document import page
from bench.run.execute import Finished, store_of
from bench.run.files import write_all
from bench.run.plan import requested_rows
from bench.run.record import record
from bench.run.rows import read_record

RESULTS = ("ok", "diverged", "nonfinite")
"""Statuses of cells that ran: where a method fails is a result too."""
NO_RESULT = "No cell gave a result: the table has the reason of each."


def finish(finished: Finished, words: Sequence[str]) -> tuple[pd.DataFrame, Views, list[Path]]:
    """Write the files of a run, the record first; return the rows in the order of the cells, their views, and the files' paths."""
    rows = finished.rows()
    simulated = any(item.runs for item in finished.planned)
    path = record(finished.experiment, rows, list(words), finished.seconds, simulated)
    views, paths = write(finished.experiment, rows)
    return rows, views, [*paths, path]


def report(experiment: Experiment) -> tuple[pd.DataFrame, Views, list[Path]]:
    """Rewrite an experiment's files from the newest stored rows of its cells, without simulation; return as :func:`finish`.

    If none of its cells is stored, all stored rows are used. Any difference from the requested cells is printed.
    """
    rows, difference = requested_rows(experiment, newest_rows(store_of(experiment).load()))
    if difference:
        print(f"bench: {difference}", file=sys.stderr)
    return rows, *write(experiment, rows)


def write(experiment: Experiment, rows: pd.DataFrame) -> tuple[Views, list[Path]]:
    """Write tables, charts and page; return the views and the files' paths. Raises :class:`UserError` without rows."""
    if rows.empty:
        raise UserError(f"no rows are stored in '{experiment.directory}': run the experiment first")
    with guard.capture_output("a plugin"), guard.protect_process():  # a study's views are a plugin's code
        views = views_of(experiment, rows)
        drawn = writer.drawings(experiment, views)
        paths = writer.write(experiment, views, drawn)
        data = page_data(experiment, rows.reset_index(drop=True), views, reproduce.commands(experiment, rows))
        text = page(experiment.name, experiment.question, views, data, drawn, read_record(experiment.directory))
        return views, [*paths, *write_all(experiment.directory, {"report.html": text})]


def views_of(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return what the study shows of its rows, or else a table of its numbers and a chart of the first."""
    rows = rows.reset_index(drop=True)
    views = experiment.study.views(experiment, rows) or generic.views(experiment, rows)
    if experiment.execution.ladder:
        views = replace(views, tables=[ladder.table(experiment, rows), *views.tables])
    if not rows["status"].isin(RESULTS).any():
        return replace(views, headline=NO_RESULT)
    try:
        return replace(views, headline=answer.fill(experiment.answer, partial(_table, views)) or views.headline)
    except LookupError as error:
        return replace(views, remarks=[*views.remarks, f"The rows no longer carry the answer: {printable(error)}"])


def _table(views: Views, name: str) -> pd.DataFrame:
    """Return the content of a table's CSV by its name."""
    named = {table.name: table for table in reversed(views.tables) if "csv" in table.files}
    if name not in named:
        raise unknown("table", name, named)
    return named[name].frame if named[name].data is None else named[name].data
