"""The page of an experiment: ``report.html``, one file that needs no network.

What a page shows of a study is said in the file of the study's name; a study without one gets its table and one chart of
its numbers.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pandas as pd

from bench.grid import Experiment
from bench.report import reproduce
from bench.report.web.content import Content
from bench.report.web.document import assemble
from bench.store import write_whole


def write(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> Path:
    """Write ``report.html`` from rows, and from ``run.json`` where there is one; returns its path."""
    rows = rows.reset_index(drop=True)
    path = experiment.directory / "report.html"
    text = assemble(experiment, content(experiment, rows, axes), reproduce.commands(experiment, rows), _record(path))
    write_whole(path, text.encode())
    return path


def content(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> Content:
    """What the page of this study shows."""
    name = f"{__name__}.{experiment.study}"
    module = importlib.import_module(name if find_spec(name) else f"{__name__}.anything")
    made: Content = module.content(experiment, rows, axes)
    return made


def _record(page: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads(page.with_name("run.json").read_text())
    except (OSError, ValueError):
        return {}
    return found
