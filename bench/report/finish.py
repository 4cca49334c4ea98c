"""Writes the output files from stored rows: tables, charts, the record of the run and the page."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from bench.errors import UserError, printable
from bench.experiment.defaults import completed_rows
from bench.experiment.experiment import Experiment
from bench.experiment.study import study_of
from bench.experiment.views import Views
from bench.model import guard
from bench.report import averages, generic, web, writer
from bench.report.cores import run_tasks
from bench.report.views import newest_rows
from bench.run.execute import Finished, store_of
from bench.run.plan import requested_rows
from bench.run.record import record
from bench.run.store import sort_rows


def finish(finished: Finished, words: Sequence[str]) -> tuple[pd.DataFrame, list[Path]]:
    """Write the files of a run, the record first; return the rows in the order of the cells, and the files' paths."""
    keys = finished.keys
    rows = finished.store.load()
    rows = completed_rows(sort_rows(rows[rows["key"].isin(keys)], keys))
    simulated = any(item.runs for item in finished.planned)
    path = record(finished.experiment, rows, list(words), finished.seconds, simulated)
    return rows, [*write(finished.experiment, rows), path]


def report(experiment: Experiment) -> tuple[pd.DataFrame, list[Path]]:
    """Rewrite an experiment's files from the newest stored rows of its cells, without simulation; return rows and paths.

    If none of its cells is stored, all stored rows are used. Any difference from the requested cells is printed.
    """
    rows, difference = requested_rows(experiment, newest_rows(store_of(experiment).load()))
    if difference:
        print(f"bench: {difference}", file=sys.stderr)
    return rows, write(experiment, rows)


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write tables, charts, page and averages; return the files' paths. Raises :class:`UserError` without rows."""
    if rows.empty:
        raise UserError(f"no rows are stored in '{experiment.directory}': run the experiment first")
    with (
        guard.capture_output("a plugin"),
        guard.protect_process(),
    ):  # building the commands that repeat cells runs code of plugins
        views = views_of(experiment, rows)
        tasks = [
            partial(_files, experiment, rows, views),
            partial(_page, experiment, rows, views),
            partial(averages.write, experiment, rows),
        ]
        return [path for paths in run_tasks(tasks) for path in paths]


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print a summary of an experiment's rows."""
    views = views_of(experiment, rows)
    if views is None:
        study: Any = study_of(experiment)
        study.show(experiment, rows)
    else:
        writer.show(experiment, rows, views)


def views_of(experiment: Experiment, rows: pd.DataFrame) -> Views | None:
    """Return what the study shows of its rows; None if the study writes its files itself, as in older versions."""
    study = study_of(experiment)
    if hasattr(study, "write"):
        return None
    views = study.views(experiment, rows.reset_index(drop=True))
    return generic.views(experiment, rows) if views is None else views


def _files(experiment: Experiment, rows: pd.DataFrame, views: Views | None) -> list[Path]:
    if views is None:
        study: Any = study_of(experiment)
        paths: list[Path] = study.write(experiment, rows)
        return paths
    return writer.write(experiment, views)


def _page(experiment: Experiment, rows: pd.DataFrame, views: Views | None) -> list[Path]:
    return [web.write(experiment, rows, views)]


def shown(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with strings on one line and without control characters, for a terminal (except ``parameters``)."""
    texts = [name for name in rows if pd.api.types.infer_dtype(rows[name], skipna=False) == "string"]
    lines = {name: {text: printable(text) for text in rows[name].unique()} for name in texts if name != "parameters"}
    return rows.assign(**{str(name): rows[name].map(lines[name]) for name in lines})
