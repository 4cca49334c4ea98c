"""Assembles the HTML file of an experiment's page: escaped texts, data by column, and the scripts that draw it."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import cache
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pandas as pd

from bench.experiment.columns import IDENTITY
from bench.experiment.experiment import Experiment
from bench.report import reproduce
from bench.report.web import shell
from bench.report.web.content import Chart, Content, PlotAxis

HERE = Path(__file__).parent
DIGITS = 6
"""Significant digits of the numbers in a page."""
MOST = 24
"""Largest number of distinct values of a column that is offered as a filter."""


def assemble(
    experiment: Experiment, content: Content, commands: Sequence[Sequence[str]], record: Mapping[str, Any]
) -> str:
    """Return the page as HTML. ``commands`` are the words that run each row's cell, ``record`` is ``run.json``."""
    counts = content.rows["status"].value_counts()
    statuses = "".join(f'<li class="{escape(str(s))}"><b>{n}</b> {escape(str(s))}</li>' for s, n in counts.items())
    parts = {
        "title": escape(experiment.name),
        "question": escape(experiment.question),
        "finding": _finding(content.finding),
        "counts": f"<li><b>{len(content.rows)}</b> cells</li>{statuses}",
        "answers": _answers(content),
        "made": _made(record),
        "data": in_script(json.dumps(data(content, commands), separators=(",", ":"), allow_nan=False)),
    }
    template = (HERE / "page.html").read_text()
    body = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)
    return shell.document(experiment.name, body, [plotly(), shell.script("page.js")])


def in_script(text: str) -> str:
    """Escape JSON so that it cannot end the script element that contains it."""
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


@cache
def plotly() -> str:
    """Return Plotly's script. It is embedded as it is, so that charts exist when a page is printed immediately."""
    spec = find_spec("plotly")
    assert spec is not None
    assert spec.origin is not None
    return (Path(spec.origin).parent / "package_data" / "plotly.min.js").read_text()


# --------------------------------------------------------------------------------------------------------- data


def data(content: Content, commands: Sequence[Sequence[str]]) -> dict[str, Any]:
    """Return the data for the page's script: tables by column, charts, filters, and the commands of all rows."""
    rows = content.rows
    filters = filtered(content)
    wanted = {"rows": {*IDENTITY, *content.swept, "reason", "status", *filters, *(c.name for c in content.columns)}}
    wanted["rows"] |= {c.flag for c in content.columns}
    for chart in content.charts:
        wanted.setdefault(chart.table, {"row"}).update(_columns_of(chart))
        wanted["rows"] |= _columns_of(chart)
    sources = {"rows": rows, **content.tables}
    flags = {c.flag for c in content.columns} | {
        axis.limit for chart in content.charts for axis in (*chart.x, *chart.y)
    }
    tables = {
        name: {
            c: column(sources[name][c].astype(float) if c in flags else sources[name][c])
            for c in sources[name]
            if c in wanted[name]
        }
        for name in wanted
    }
    longest = max(map(len, commands), default=0)
    words = [[line[i] if i < len(line) else "" for line in commands] for i in range(longest)]
    return {
        "tables": tables,
        "columns": [asdict(c) for c in content.columns],
        "charts": [asdict(chart) for chart in content.charts],
        "looks": content.looks,
        "filters": filters,
        "identity": [c for c in dict.fromkeys((*IDENTITY, *content.swept)) if c in rows],
        "command": {"head": reproduce.HEAD, "words": [column(pd.Series(part, dtype=object)) for part in words]},
    }


def filtered(content: Content) -> list[str]:
    """Return the columns to filter by: cell identity, swept parameters and verdicts of the table, where they vary.

    Columns with more than :data:`MOST` values and the column ``reason`` are omitted.
    """
    rows = content.rows
    texts = [column.name for column in content.columns if column.kind == "text" and column.name != "reason"]
    names = dict.fromkeys((*IDENTITY, *content.swept, *texts, "experiment", "status"))
    return [name for name in names if name in rows and 1 < rows[name].nunique(dropna=False) <= MOST]


def _columns_of(chart: Chart) -> set[str]:
    axes: list[PlotAxis] = [*chart.x, *chart.y]
    names = {name for axis in axes for name in (axis.column, axis.low, axis.high, axis.limit)}
    return names | {chart.series, chart.facet, chart.line, chart.front, chart.level, chart.fill, chart.cell}


def column(values: pd.Series) -> Any:
    """Encode a column for JSON: numbers rounded, None where missing; texts as distinct values and an index."""
    if pd.api.types.is_bool_dtype(values) or not pd.api.types.is_numeric_dtype(values):
        codes, unique = pd.factorize(values.astype(str))
        return {"values": list(unique), "index": codes.tolist()}
    return [_short(value) for value in values.tolist()]


def _short(value: float) -> float | int | None:
    if value is None or not math.isfinite(value):
        return None
    value = float(f"{value:.{DIGITS}g}")
    return int(value) if value.is_integer() and abs(value) < 1e15 else value


# -------------------------------------------------------------------------------------------------------- texts


def _finding(text: str) -> str:
    """Return the finding as HTML; each part after the first semicolon is a separate line in a smaller font."""
    first, *rest = text.split("; ")
    return escape(first) + "".join(f"<span>{escape(part)}</span>" for part in rest)


def _answers(content: Content) -> str:
    """Return the answers as an HTML table with its heading; empty without answers."""
    table = content.answers
    if table.empty:
        return ""
    return f'<section id="answers"><h2>{escape(content.answers_title)}</h2>{shell.table(table)}</section>'


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
