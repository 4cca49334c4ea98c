"""Assembles the HTML file of an experiment's page: escaped texts, drawings, the cells by column, and their script."""

from __future__ import annotations

import json
import re
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from itertools import starmap
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Views
from bench.report.cells import readable
from bench.report.web import shell
from bench.report.web.data import page_data

HERE = Path(__file__).parent


def blocks(
    experiment: Experiment,
    rows: pd.DataFrame,
    views: Views,
    drawn: Sequence[tuple[Chart, Figure]],
    commands: Sequence[Sequence[str]],
    record: Mapping[str, Any],
) -> Iterator[str]:
    """Yield the page as HTML in blocks, so that a long page is never in memory as one string.

    ``commands`` are the words that run each row's cell, ``record`` is ``run.json``.
    """
    counts = (rows if views.rows is None else views.rows)["status"].value_counts()
    statuses = "".join(f'<li class="{escape(str(s))}"><b>{n}</b> {escape(str(s))}</li>' for s, n in counts.items())
    data = page_data(experiment, rows, views, commands)
    parts = {
        "title": escape(experiment.name),
        "question": escape(experiment.question),
        "headline": escape(views.headline),
        "counts": f"<li><b>{counts.sum()}</b> cells</li>{statuses}",
        "answers": _answers(views),
        "charts": "\n".join(starmap(_chart, drawn)),
        "made": _made(record),
        "data": (place := uuid.uuid4().hex),
    }
    template = (HERE / "page.html").read_text()
    body = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)
    before, after = shell.document(experiment.name, body, [shell.script("page.js")]).split(place)
    yield before
    yield from map(in_script, json_blocks(data))
    yield after


def json_blocks(value: Any) -> Iterator[str]:
    """Yield a value as JSON: the items of nested dictionaries one by one. Of a function its result is yielded."""
    value = value() if callable(value) else value
    if isinstance(value, dict) and value:
        for number, (name, inner) in enumerate(value.items()):
            yield f"{',' if number else '{'}{json.dumps(name)}:"
            yield from json_blocks(inner)
        yield "}"
    else:
        yield json.dumps(value, separators=(",", ":"), allow_nan=False)


def in_script(text: str) -> str:
    """Escape JSON so that it cannot end the script element that contains it."""
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


# -------------------------------------------------------------------------------------------------------- texts


def _answers(views: Views) -> str:
    """Return the first table meant for the page as HTML with its heading; empty if there is none."""
    table = next((table for table in views.tables if table.page), None)
    if table is None or table.frame.empty:
        return ""
    texts = readable(table)
    if table.split:
        texts.insert(0, "", table.frame[table.split].to_numpy())
    return f'<section id="answers"><h2>{escape(table.title)}</h2>{shell.table(texts)}</section>'


def _chart(chart: Chart, figure: Figure) -> str:
    """Return a chart as HTML with its heading and how to read it."""
    title = chart.title or chart.name.replace("_", " ").capitalize()
    text = f"<p>{escape(chart.text)}</p>" if chart.text else ""
    return f"<section><h2>{escape(title)}</h2>{text}{shell.drawing(figure, chart.name, title)}</section>"


def _made(record: Mapping[str, Any]) -> str:
    """Return the run's machine, versions and configuration as HTML, as far as they are recorded."""
    if not record:
        return "<p>There is no run.json beside this page, so machine and versions are not known.</p>"
    machine = record.get("machine") or {}
    facts = {
        "command": record.get("command"),
        "finished": record.get("finished"),
        "duration": f"{record.get('duration_s')} s",
        "machine": ", ".join(_texts(machine.get("processor"), f"{machine.get('cores')} cores", machine.get("system"))),
        "load average": ", ".join(f"{load:.2f}" for load in machine.get("load_average") or []),
        "commit": record.get("git_commit"),
        "versions": ", ".join(
            _texts(
                f"python {record.get('python')}", *(f"{k} {v}" for k, v in (record.get("versions") or {}).items() if v)
            )
        ),
    }
    terms = "".join(f"<dt>{escape(k)}</dt><dd>{escape(str(v))}</dd>" for k, v in facts.items() if v)
    config = escape(json.dumps(record.get("config"), indent=1))
    return f'<dl>{terms}</dl><h3>Configuration</h3><pre tabindex="0">{config}</pre>'


def _texts(*values: Any) -> Iterable[str]:
    return (str(value) for value in values if value)
