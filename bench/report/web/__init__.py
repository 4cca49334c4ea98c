"""Writes the page of an experiment: ``report.html``, a single file that needs no network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Views
from bench.report import reproduce
from bench.report.web.data import page_data
from bench.report.web.document import page
from bench.run.files import write_whole
from bench.run.rows import read_record


def write(
    experiment: Experiment, rows: pd.DataFrame, views: Views, drawn: Sequence[tuple[Chart, Figure]]
) -> list[Path]:
    """Write ``report.html`` from rows, what the study shows of them and its charts, with the facts of ``run.json``; return its path."""
    rows = rows.reset_index(drop=True)
    path = experiment.directory / "report.html"
    data = page_data(experiment, rows, views, reproduce.commands(experiment, rows))
    text = page(experiment.name, experiment.question, views, data, drawn, read_record(path.parent))
    write_whole(path, text.encode())
    return [path]
