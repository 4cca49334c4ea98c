"""Writes a comparison as files and as a page, and prints it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd

from bench.compare import timings
from bench.compare.cells import FIRST, LAST, OUTCOMES, WORSE_IN, both_sides, differing_parameters, flat_parameters
from bench.compare.exports import as_json, as_junit, count_outcomes
from bench.compare.judging import NOTES
from bench.experiment import views
from bench.experiment.columns import Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Views
from bench.model import registry
from bench.report import terminal, writer
from bench.report.problems import varying_identity
from bench.report.tables import plain_markdown
from bench.report.text import axis_value, counted, one_line
from bench.report.web.document import blocks
from bench.run.files import make_directory, write_all

PRINTED = 30
"""Largest number of printed changes. The files contain all changes."""
LISTED = 100
"""Largest number of changes in the Markdown file, which CI servers show above a run."""
PHRASES = {"gone": "gone", "status": "no longer ok"}
"""Phrases of the summary for changes that are not of one column."""
STYLES = dict(
    zip(OUTCOMES, (Style("#D55E00", "^"), Style("#0072B2", "v"), Style("#CC79A7", "s"), Style("#7F6000")), strict=True)
)


@dataclass(frozen=True, eq=False)
class Comparison:
    """All experiments that two results have in common, cell by cell."""

    title: str
    table: pd.DataFrame
    """The lines of :func:`bench.compare.cells.compare_cells`, with the column ``experiment``."""
    remarks: Sequence[str]
    judged: Sequence[Column]
    """The judged columns of all studies, each name once."""
    study: str
    """The study of the first experiment."""

    @property
    def worse(self) -> bool:
        """Whether some cell got worse."""
        return bool((self.table["outcome"] == "worse").any())

    def __str__(self) -> str:
        changes = self.changes.head(PRINTED)
        lines = [self.title, summary(self.table), *(f"  {remark}" for remark in self.remarks)]
        lines += [": ".join(map(str, line)) for line in changes.to_numpy()]
        return "\n".join(map(one_line, lines))

    __repr__ = __str__

    def _repr_html_(self) -> str:
        paragraphs = (self.title, summary(self.table), *self.remarks)
        text = "".join(f"<p>{escape(paragraph)}</p>" for paragraph in paragraphs)
        return text + str(self.changes.head(PRINTED).to_html(index=False, border=0))

    def to_frame(self) -> pd.DataFrame:
        """Return one row per cell: its name, the outcome, what changed, and both sides of every judged column."""
        columns = ["experiment", *FIRST, *both_sides(self.judged), *LAST]
        return self.table[columns].assign(cell=self.cells)

    @cached_property
    def cells(self) -> list[str]:
        """The name of each cell, in the order of the table."""
        return cell_names(self.table)

    @property
    def changes(self) -> pd.DataFrame:
        """The columns ``outcome``, ``experiment``, ``cell`` and ``change`` of the changed cells, the worst first."""
        named = self.table.assign(cell=self.cells)[["outcome", "experiment", "cell", "change"]]
        return _worst_first(named[named["outcome"] != "same"])


def summary(table: pd.DataFrame) -> str:
    """Return a sentence: how many cells got worse and in which columns, how many got better, how many are the same."""
    counts = count_outcomes(table)
    subjects = Counter(subject for subjects in table[WORSE_IN] for subject in subjects)
    reasons = ", ".join(f"{n} {PHRASES.get(subject, f'in {subject}')}" for subject, n in subjects.most_common())
    return (
        f"Of {counted(len(table), 'cell')}, {counts['worse']} got worse{f' ({reasons})' if reasons else ''}, "
        f"{counts['better']} got better, {counts['same']} are the same within the uncertainty."
    )


def write(comparison: Comparison, out: Path) -> list[Path]:
    """Write ``compare`` as .csv, .md, .json, .xml (JUnit) and .html. Raises :class:`StorageError` if that fails."""
    make_directory(out)
    table = comparison.table
    return write_all(
        out,
        {
            "compare.csv": comparison.to_frame().drop(columns="cell").to_csv(index=False, lineterminator="\n"),
            "compare.md": markdown(comparison),
            "compare.json": as_json(comparison.title, table, comparison.cells, comparison.remarks),
            "compare.xml": as_junit(comparison.title, table, comparison.cells),
            "compare.html": page(comparison),
        },
    )


def markdown(comparison: Comparison) -> str:
    """Return the summary, counts by experiment, remarks, first changes (the worst first) and rules as Markdown."""
    table = comparison.table
    listed = comparison.changes
    by_experiment = pd.DataFrame(
        [{"experiment": str(name)} | count_outcomes(part) for name, part in table.groupby("experiment", sort=False)]
    ).astype(str)
    texts = [f"# {comparison.title}", summary(table), plain_markdown(by_experiment), *comparison.remarks]
    if not listed.empty:
        texts.append(plain_markdown(listed.head(LISTED)))
    if len(listed) > LISTED:
        texts.append(f"And {len(listed) - LISTED} more in `compare.csv`.")
    return "\n\n".join([*texts, "\n".join(f"- {note}" for note in (*NOTES, timings.NOTE))]) + "\n"


def show(comparison: Comparison, paths: Sequence[Path]) -> None:
    """Print the summary, the remarks and the first changes."""
    console = terminal.open_console()
    console.print(f"\n{comparison.title}", style="bold")
    console.print(summary(comparison.table))
    for remark in comparison.remarks:
        console.print(f"  {remark}")
    listed = comparison.changes
    if not listed.empty:
        terminal.print_table(console, listed.head(PRINTED), least_important=("experiment",))
    if len(listed) > PRINTED:
        console.print(f"and {len(listed) - PRINTED} more in the files")
    print("\nWritten:")
    for path in paths:
        print(f"  {path}")


def _worst_first(table: pd.DataFrame) -> pd.DataFrame:
    return table.iloc[table["outcome"].map(OUTCOMES.index).argsort(kind="stable")]


def cell_names(table: pd.DataFrame) -> list[str]:
    """Return a name for each cell: the identity columns that vary, and the parameters in which cells of one name differ."""
    columns = varying_identity(table)
    names = [", ".join(filter(None, map(_name_part, columns, row))) for row in table[columns].to_numpy(dtype=object)]
    positions: dict[tuple[str, str], list[int]] = {}
    for position, key in enumerate(zip(table["experiment"], names, strict=True)):
        positions.setdefault(key, []).append(position)
    for (_, name), same_name in positions.items():
        if len(same_name) > 1:
            flat = [flat_parameters(table.iloc[position].to_dict()) for position in same_name]
            differing = differing_parameters(flat)
            for position, parameters in zip(same_name, flat, strict=True):
                parts = [_name_part(key, parameters.get(key)) for key in differing]
                names[position] = ", ".join(filter(None, [name, *parts]))
    return names


def _name_part(name: str, value: Any) -> str:
    if isinstance(value, str):
        return "" if value == "none" else value
    if isinstance(value, float) and not math.isfinite(value):
        return ""
    return f"{name}={axis_value(value) if isinstance(value, float) else value}"


def page(comparison: Comparison) -> str:
    """Return the comparison as an HTML page in the layout of an experiment's page."""
    study = registry.make("studies", comparison.study)
    experiment = Experiment(
        name=comparison.title, study=study, columns=study.columns, choices={}, question="Did something get worse?"
    )
    shown = page_views(comparison)
    assert shown.rows is not None
    return "".join(blocks(experiment, shown.rows, shown, writer.drawings(experiment, shown), [], {}))


def page_views(comparison: Comparison) -> Views:
    """Return the summary, the rules, all cells before and after, and a chart per number: the worst cells first."""
    table = _worst_first(comparison.table).reset_index(drop=True)
    rows = table.drop(columns=WORSE_IN).assign(status=table["status_after"], reason=table["change"])
    rules = pd.DataFrame({"remark": [*comparison.remarks, *NOTES, timings.NOTE]})
    columns = [
        Column(
            f"{column.name}_{when}", label=f"{_called(column)} {when}", unit=column.unit, kind=column.kind,
            format="seconds" if column.unit == "s" else "number",
        )
        for column in comparison.judged
        for when in ("before", "after")
    ]  # fmt: skip
    return Views(
        headline=summary(table),
        tables=[views.Table("rules", rules, [text("remark")], "How cells are judged", files=[], page=True)],
        charts=[
            _before_after(before, after, rows)
            for before, after in zip(columns[::2], columns[1::2], strict=True)
            if before.kind == "number" and rows[after.name].notna().any()
        ],
        rows=rows,
        columns=[text("outcome"), text("experiment"), *columns],
    )  # fmt: skip


def _called(column: Column) -> str:
    return column.comparison.called if column.comparison else column.name


def _before_after(before: Column, after: Column, rows: pd.DataFrame) -> Chart:
    title = after.heading.replace(" after", "").capitalize()
    frame = rows[["outcome", "experiment", before.name, after.name]].assign(row=range(len(rows)))
    return Chart(
        after.name, frame, [before], [after], "points", title, series="outcome", panel="experiment", styles=STYLES,
        text="Points above the diagonal are larger after.",
    )  # fmt: skip
