"""Assembles the HTML file of an experiment's page: escaped texts, drawings, the cells by column, and their script."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from html import escape
from itertools import starmap
from types import MappingProxyType
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from bench.experiment.views import Chart, Views
from bench.report.cells import readable
from bench.report.draw import Drawn
from bench.report.web import shell


def page(
    title: str,
    question: str,
    views: Views,
    data: Mapping[str, Any],
    drawn: Drawn = (),
    record: Mapping[str, Any] = MappingProxyType({}),
) -> str:
    """Return the page as HTML. ``data`` are the cells, see :func:`~bench.report.web.data.cells_data`, and ``record`` is ``run.json``."""
    counts = [(data["count"], "cells"), *((n, str(status)) for status, n in data["statuses"].items())]
    parts = {
        "title": escape(title),
        "question": escape(question),
        "headline": escape(views.headline),
        "counts": "".join(f'<li class="{escape(name)}"><b>{n}</b> {escape(name)}</li>' for n, name in counts),
        "answers": _answers(views),
        "charts": "\n".join(starmap(_chart, drawn)),
        "made": _made(record),
        "data": in_script(json.dumps(data, separators=(",", ":"), allow_nan=False)),
    }
    body = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], shell.file_text("page.html"))
    return shell.document(title, body, [shell.file_text("page.js")])


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
        texts.insert(0, table.split.strip("_"), table.frame[table.split].to_numpy())
    return f'<section id="answers"><h2>{escape(table.title)}</h2>{shell.table(texts)}</section>'


def _chart(chart: Chart, widths: Sequence[Figure]) -> str:
    """Return a chart as HTML with its heading."""
    title = chart.title or chart.name.replace("_", " ").capitalize()
    return f"<section><h2>{escape(title)}</h2>{shell.drawing(widths, chart.name, title)}</section>"


def _made(record: Mapping[str, Any]) -> str:
    """Return all facts about the run and its configuration as HTML, as far as they are recorded."""
    if not record:
        return "<p>There is no run.json beside this page, so machine and versions are not known.</p>"
    facts = pd.json_normalize({name: value for name, value in record.items() if name != "config"}).loc[0].dropna()
    terms = "".join(f"<dt>{escape(str(k))}</dt><dd>{escape(str(v))}</dd>" for k, v in facts.items())
    config = escape(json.dumps(record.get("config"), indent=1))
    return f'<dl>{terms}</dl><h3>Configuration</h3><pre tabindex="0">{config}</pre>'
