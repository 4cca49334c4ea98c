"""Writes what a study shows, given as data: tables as CSV, Markdown and LaTeX, charts as files, the answer as JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Table, Views
from bench.report import terminal
from bench.report.cells import TableCell, parts, readable, text_rows
from bench.report.colours import looks_by_name
from bench.report.draw import NARROW, Drawn, draw
from bench.report.figures import save, styled
from bench.report.latex import latex
from bench.report.tables import csv_text, escape_markdown
from bench.report.text import counted, one_line
from bench.run.files import write_all

ANSWER = "answer.json"
"""The file with an experiment's question, answer and main chart."""
NO_ANSWER = "No answer is written for these settings: the tables have the results."
"""What the terminal shows where an experiment has a question, and its answer is missing or is of other settings."""
LEAST = 3
"""Fewest values that are drawn."""


def write(experiment: Experiment, views: Views, drawn: Drawn) -> list[Path]:
    """Write all tables, the charts as :func:`drawings` gives them, and the answer of an experiment; return the files' paths."""
    charts = []
    with styled():
        for chart, widths in drawn:
            figure = widths[-1 if experiment.chart_columns == 1 else 0]
            charts += save(figure, experiment.directory / chart.name, experiment.formats, chart.plotted())
    answer = answer_json(experiment.name, experiment.question, views.headline, drawn)
    files = {ANSWER: answer}
    for name in dict.fromkeys(table.name for table in views.tables):
        files |= table_files([table for table in views.tables if table.name == name], experiment.name)
    return [*write_all(experiment.directory, files), *charts]


def drawings(experiment: Experiment, views: Views) -> list[tuple[Chart, list[Figure]]]:
    """Return the charts with enough values to show something, drawn; the first has the experiment's question as its title.

    A chart that is wider than one column of a paper is drawn a second time as wide as that.
    """
    charts = [chart for chart in views.charts if _is_telling(chart)]
    looks = looks_by_name(charts)
    drawn = []
    with styled():
        for chart in charts:
            title = experiment.question * (chart is charts[0]) or chart.title or experiment.question
            shown = replace(chart, title=title, styles={**looks, **chart.styles})
            figure = draw(shown)
            is_wide = figure.get_figwidth() > NARROW
            drawn.append((chart, [figure, *([draw(shown, is_narrow=True)] if is_wide else [])]))
    return drawn


def _is_telling(chart: Chart) -> bool:
    """Return whether at least :data:`LEAST` points are drawn, and lines have as many places along a numeric axis."""
    frame, x = chart.frame, chart.x[0].name
    is_line = chart.kind == "lines" and pd.api.types.is_numeric_dtype(frame[x])
    return len(frame) >= LEAST and (not is_line or frame[x].nunique() >= LEAST)


def answer_json(experiment: str, question: str, answer: str, drawn: Drawn) -> str:
    """Return the content of :data:`ANSWER`."""
    chart = drawn[0][0].name if drawn else ""
    content = {"experiment": experiment, "question": question, "answer": answer, "chart": chart}
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def table_files(tables: Sequence[Table], experiment: str) -> dict[str, str]:
    """Return the content of each file of tables with one name; the CSV has the first."""
    first = tables[0]
    makers: dict[str, Callable[[], str]] = {
        "csv": lambda: csv_text(first.frame if first.data is None else first.data),
        "md": lambda: markdown(tables, experiment),
        "tex": lambda: latex([table for table in tables if "tex" in table.files], experiment),
    }
    return {f"{first.name}.{kind}": makers[kind]() for kind in first.files if first.columns or kind == "csv"}


# --------------------------------------------------------------------------------------------------------- files


def markdown(tables: Sequence[Table], experiment: str) -> str:
    """Return tables as Markdown, the first with a title above, each with its notes below."""
    e = escape_markdown
    blocks = []
    for number_, table in enumerate(tables):
        title = e(f"{experiment}: {table.title}" if table.title and number_ == 0 else table.title or experiment)
        blocks += [f"# {title}" if number_ == 0 else f"**{title}**"]
        for heading, part in parts(table):
            if heading:
                blocks.append(f"**{e(heading)}**")
            head = "| " + " | ".join(e(column.heading) for column in table.columns) + " |"
            rule = "|" + "".join("--:|" if column.kind == "number" else "---|" for column in table.columns)
            lines = ["| " + " | ".join(row) + " |" for row in text_rows(table.columns, part, _in_markdown)]
            blocks.append("\n".join([head, rule, *lines]))
        blocks += [note if note.startswith("    ") else e(note) for note in table.notes]  # a command is a block of code
    return "\n\n".join(blocks) + "\n"


def _in_markdown(one: TableCell) -> str:
    value = f"**{escape_markdown(one.value)}**" if one.bold and one.value else escape_markdown(one.value)
    return " ".join(filter(None, (value, *map(escape_markdown, (one.interval, one.note)))))


# ------------------------------------------------------------------------------------------------------ terminal


def show(experiment: Experiment, rows: pd.DataFrame, views: Views) -> None:
    """Print the counts of cells, the headline, the tables that are meant for the terminal, and the headline again.

    Notes of a table that are in its Markdown file are not repeated.
    """
    console = terminal.open_console()
    console.print(f"\n{experiment.name}: {experiment.question}" if experiment.question else f"\n{experiment.name}")
    counts = rows["status"].value_counts()
    console.print(f"{counted(len(rows), 'cell')}: " + ", ".join(f"{n} {status}" for status, n in counts.items()))
    headline = one_line(views.headline)
    if headline or experiment.question:
        console.print(headline or NO_ANSWER)
    for table in views.tables:
        if table.terminal:
            right = {column.heading for column in table.columns if column.kind == "number"}
            for place, (heading, part) in enumerate(parts(table)):
                texts, omitted = _terminal_text(replace(table, frame=part), console.width)
                terminal.print_table(console, texts, heading or (table.title if place == 0 else ""), right, omitted)
            for note in table.notes if "md" not in table.files else ():
                console.print(one_line(note))
    for text in map(one_line, views.remarks):
        console.print(text, soft_wrap="python -m bench" in text)  # a command stays one line, so that it can be copied
    if headline:
        console.print(f"\n{headline}")


def _terminal_text(table: Table, width: int) -> tuple[pd.DataFrame, list[str]]:
    """Return a table as strings without its details, and without intervals if these make it wider than ``width``, and what is omitted."""
    columns = [column for column in table.columns if column.name not in table.details]
    texts = readable(replace(table, columns=columns))
    natural = sum(max([*map(len, texts[name]), *map(len, name.split())], default=0) + 2 for name in texts)
    if natural - 2 <= width or not any(column.low for column in columns):
        return texts, []
    return readable(replace(table, columns=[replace(column, low="", high="") for column in columns])), ["95% intervals"]


def reasons(rows: pd.DataFrame) -> list[str]:
    """Return why cells failed, were refused or have remarks; counted together where reasons differ only in numbers.

    All that are unsupported are one line.
    """
    given = rows[rows["reason"] != ""]
    kinds = given["reason"].str.replace(r"\d+(\.\d+)?(e[+-]?\d+)?", "#", regex=True)
    kinds = kinds.mask(given["status"] == "unsupported", "")
    groups = sorted(given.groupby(["status", kinds]), key=lambda item: -len(item[1]))
    return [
        f"{len(part)} {status}: {part['reason'].iloc[0]}" + ("" if part["reason"].nunique() == 1 else " (for example)")
        for (status, _), part in groups
    ]
