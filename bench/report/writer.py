"""Writes what a study shows, given as data: tables as CSV, Markdown and LaTeX, charts as files, findings as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from bench.experiment.columns import Column
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Table, Views
from bench.report.cores import run_tasks
from bench.report.draw import draw
from bench.report.figures import save, styled
from bench.report.tables import csv, escape_latex, escape_markdown
from bench.report.text import axis_value, duration, number
from bench.run.files import write_all

FINDINGS = "findings.json"
"""The file with an experiment's question, findings and main chart."""


def write(experiment: Experiment, views: Views) -> list[Path]:
    """Write all tables, charts and findings of an experiment; return the files' paths."""
    contents = {FINDINGS: _findings(experiment, views)}
    for table in views.tables:
        contents |= table_files(table, experiment.name)
    tasks = [partial(_draw, experiment, chart) for chart in views.charts if chart.printed and len(chart.frame)]
    paths = [path for saved in run_tasks(tasks) for path in saved]
    return [*write_all(experiment.directory, contents), *paths]


def _draw(experiment: Experiment, chart: Chart) -> list[Path]:
    with styled():
        return save(draw(chart), experiment.directory / chart.name, experiment.formats, chart.plotted())


def _findings(experiment: Experiment, views: Views) -> str:
    main = next((chart.name for chart in views.charts if chart.printed and len(chart.frame)), "")
    content = {
        "experiment": experiment.name, "question": experiment.question, "findings": list(views.findings), "chart": main
    }  # fmt: skip
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def table_files(table: Table, experiment: str) -> dict[str, str]:
    """Return the content of a table's files by name."""
    makers = {
        "csv": lambda: csv(table.frame if table.data is None else table.data),
        "md": lambda: markdown(table, experiment),
        "tex": lambda: latex(table),
    }
    return {f"{table.name}.{kind}": makers[kind]() for kind in table.files}


# -------------------------------------------------------------------------------------------------------- cells


def cell_text(column: Column, row: Mapping[Any, Any]) -> str:
    """Return the value of a column in a row as a string for readers, with its interval: ``0.50 [0.40, 0.60]``.

    An upper limit is ``< 0.12``, a missing number ``-``.
    """
    value = row[column.name]
    if column.kind != "number" or isinstance(value, str):
        return "" if value is None or value is pd.NA else str(value)
    if value is None or math.isnan(value):
        return "-"
    if column.limit and row[column.limit]:
        return f"< {value_text(column, row[column.high] if column.high else value)}"
    text = value_text(column, value)
    if column.low and column.high:
        ends = [float(row[name]) for name in (column.low, column.high)]
        if not all(map(math.isnan, ends)):
            text += " [{}, {}]".format(*(value_text(column, end) for end in ends))
    return text


def value_text(column: Column, value: float) -> str:
    """Return a number in the format of a column."""
    if column.format == "seconds":
        return duration(value)
    if column.format == "percent":
        return "-" if math.isnan(value) else f"{number(100 * value, column.digits)}%"
    if column.format == "setting":
        return axis_value(value)
    return number(value, column.digits)


def readable(table: Table) -> pd.DataFrame:
    """Return the table as strings for readers; the headings are the names of the columns."""
    lines = [[cell_text(column, row) for column in table.columns] for row in table.frame.to_dict("records")]
    return pd.DataFrame(lines, columns=[column.heading for column in table.columns])


def parts(table: Table) -> list[tuple[str, pd.DataFrame]]:
    """Return the readable parts of a table with their headings; one part without a heading where it is not split."""
    texts = readable(table)
    if not table.split:
        return [("", texts)]
    groups = table.frame[table.split].reset_index(drop=True)
    return [(str(name), texts.loc[index]) for name, index in groups.groupby(groups, sort=False).groups.items()]


def is_numeric(column: Column) -> bool:
    """Return whether a column is right-aligned."""
    return column.kind == "number"


# --------------------------------------------------------------------------------------------------------- files


def markdown(table: Table, experiment: str) -> str:
    """Return a table as Markdown with its title and notes."""
    blocks = [f"# {experiment}: {table.title}" if table.title else f"# {experiment}"]
    rule = "|" + "".join("--:|" if is_numeric(column) else "---|" for column in table.columns)
    for heading, texts in parts(table):
        if heading:
            blocks.append(f"**{escape_markdown(heading)}**")
        head = "| " + " | ".join(map(escape_markdown, texts)) + " |"
        lines = ["| " + " | ".join(map(escape_markdown, line)) + " |" for line in texts.to_numpy()]
        blocks.append("\n".join([head, rule, *lines]))
    return "\n\n".join([*blocks, *table.notes]) + "\n"


def latex(table: Table) -> str:
    """Return a table as a LaTeX ``tabular`` with rules of the booktabs package, to be put into a table environment."""
    spec = "".join("r" if is_numeric(column) else "l" for column in table.columns)
    lines = [r"\begin{tabular}{@{}" + spec + "@{}}", r"\toprule"]
    for number_, (heading, texts) in enumerate(parts(table)):
        if number_ == 0:
            lines += [" & ".join(map(escape_latex, texts)) + r" \\", r"\midrule"]
        if heading:
            lines += [r"\midrule"] * (number_ > 0) + [
                rf"\multicolumn{{{len(table.columns)}}}{{@{{}}l}}{{\textit{{{escape_latex(heading)}}}}} \\"
            ]
        lines += [" & ".join(map(escape_latex, line)) + r" \\" for line in texts.to_numpy()]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


# ------------------------------------------------------------------------------------------------------ terminal


def show(experiment: Experiment, rows: pd.DataFrame, views: Views) -> None:
    """Print the counts of cells, the findings, and the tables that are meant for the terminal."""
    from bench.report.study_tables import open_console, print_table

    console = open_console(experiment, rows)
    for table in views.tables:
        if table.terminal:
            right = {column.heading for column in table.columns if is_numeric(column)}
            for place, (heading, texts) in enumerate(parts(table)):
                title = heading or (table.title if place == 0 else "")
                print_table(console, texts, right=right, title=title)
            console.print(*table.notes, sep="\n")
    for text in (*views.remarks, *views.findings):
        console.print(text)


def reasons(rows: pd.DataFrame) -> Sequence[str]:
    """Return each distinct reason in the rows once."""
    return list(rows.loc[rows["reason"] != "", "reason"].unique())
