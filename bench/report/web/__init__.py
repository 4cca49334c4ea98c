"""Writes the page of an experiment: ``report.html``, a single file that needs no network.

The experiment's study returns the content. If it returns None, the page has the table and one chart of its numbers.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from bench.errors import UserError
from bench.experiment.experiment import Experiment
from bench.experiment.study import study_of
from bench.experiment.views import Views
from bench.report import generic, reproduce
from bench.report.views import arrange
from bench.report.web import from_views
from bench.report.web.content import Content
from bench.report.web.document import assemble
from bench.run.files import write_whole
from bench.run.rows import read_record


def write(experiment: Experiment, rows: pd.DataFrame, views: Views | None = None) -> Path:
    """Write ``report.html`` from rows, and from ``run.json`` if it exists; return the path of the page."""
    rows = rows.reset_index(drop=True)
    path = experiment.directory / "report.html"
    text = assemble(experiment, content(experiment, rows, views), reproduce.commands(experiment, rows), _record(path))
    write_whole(path, text.encode())
    return path


def content(experiment: Experiment, rows: pd.DataFrame, views: Views | None = None) -> Content:
    """Return the content of the experiment's page, with a column for every swept parameter.

    Without ``views`` it is the content that the study's method ``page`` returns, as in older versions. Raises
    :class:`UserError` if that is not a :class:`Content`.
    """
    result = from_views.content(experiment, rows, views) if views else _old_content(experiment, rows)
    shown = arrange(experiment, rows)
    swept = [axis.column for axis in shown.axes]
    missing = {name: shown.rows[name].to_numpy() for name in swept if name not in result.rows}
    return replace(result, rows=result.rows.assign(**missing), swept=swept)


def _old_content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    study = study_of(experiment)
    page = getattr(study, "page", None)
    result = page(experiment, rows) if page else None
    if result is None:
        views = study.views(experiment, rows) or generic.views(experiment, rows)
        return from_views.content(experiment, rows, views)
    if not isinstance(result, Content):
        raise UserError(f"study {study.name}: page() must return a bench.report.web.content.Content or None")
    return result


def _record(page: Path) -> dict[str, Any]:
    return read_record(page.parent)
