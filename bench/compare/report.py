"""Writes a comparison as files and as a page, and prints it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.compare import timings
from bench.compare.cells import FIRST, LAST, OUTCOMES, both_sides
from bench.compare.judging import NOTES
from bench.compare.machine import as_json, as_junit, counts
from bench.experiment.columns import Column
from bench.experiment.experiment import Experiment
from bench.model import registry
from bench.report.tables import plain_markdown
from bench.report.text import axis_value, counted
from bench.report.web.content import STATUS, Chart, Content, PlotAxis, identity_columns, look
from bench.report.web.content import TableColumn as Shown
from bench.report.web.document import assemble
from bench.run.files import make_directory, write_all

PRINTED = 30
"""Most changes that are printed; the files have all of them."""
LISTED = 100
"""Most changes that the Markdown lists, since CI servers show it above a run."""
LOOKS = dict(
    zip(
        OUTCOMES,
        (
            look("#D55E00", "triangle-up"), look("#0072B2", "triangle-down"), look("#CC79A7", "square"),
            look("#7F6000", "circle"),
        ),
        strict=True,
    )
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Comparison:
    """All experiments that two results have in common, cell by cell."""

    title: str
    table: pd.DataFrame
    """The lines of :func:`bench.compare.cells.compared`, with the column ``experiment``."""
    remarks: Sequence[str]
    judged: Sequence[Column]
    """The judged columns of all studies, each name once."""
    study: str
    """Return a study of the rows."""

    @property
    def worse(self) -> bool:
        """Whether some cell got worse."""
        return bool((self.table["outcome"] == "worse").any())


def summary(table: pd.DataFrame) -> str:
    """Say how many cells got worse, got better and stayed the same, and which columns of the worse ones did."""
    counts = table["outcome"].value_counts()
    parts = [f"{counts.get(kind, 0)} got {kind}" for kind in ("worse", "better")]
    text = f"{', '.join(parts)}, {counts.get('same', 0)} are the same within what was measured"
    worse = table.loc[table["outcome"] == "worse", "change"]
    changes = Counter(change.partition(" ")[0] for text in worse for change in text.split("; "))
    most = ", ".join(f"{count} in {kind}" for kind, count in changes.most_common())
    return f"Of {counted(len(table), 'cell')} {text}" + (f"; of the worse, {most}." if most else ".")


def write(comparison: Comparison, out: Path) -> list[Path]:
    """``compare`` as .csv, .md, .json, .xml (JUnit) and .html; raises :class:`StorageError` where it cannot be written."""
    make_directory(out)
    table = comparison.table
    names = _cells(table, _names(table))
    columns = ["experiment", *FIRST, *both_sides(comparison.judged), *LAST]
    return write_all(
        out,
        {
            "compare.csv": table[columns].to_csv(index=False, lineterminator="\n"),
            "compare.md": markdown(comparison),
            "compare.json": as_json(comparison.title, table, names, comparison.remarks),
            "compare.xml": as_junit(comparison.title, table, names),
            "compare.html": page(comparison),
        },
    )


def markdown(comparison: Comparison) -> str:
    """Return the summary: the sentence, counts by experiment, the remarks and the first changes, the worst first."""
    table = comparison.table
    listed = _worst_first(table[table["outcome"] != "same"])
    by_experiment = pd.DataFrame(
        [{"experiment": str(name)} | counts(part) for name, part in table.groupby("experiment", sort=False)]
    ).astype(str)
    texts = [f"# {comparison.title}", summary(table), plain_markdown(by_experiment), *comparison.remarks]
    if not listed.empty:
        texts.append(plain_markdown(_readable(listed, _names(table)).head(LISTED)))
    if len(listed) > LISTED:
        texts.append(f"And {len(listed) - LISTED} more in `compare.csv`.")
    return "\n\n".join([*texts, "\n".join(f"- {note}" for note in (*NOTES, timings.NOTE))]) + "\n"


def show(comparison: Comparison, paths: Sequence[Path]) -> None:
    """Print the summary, the remarks and the first changes."""
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = max(console.width, 160)
    console.print(f"\n{comparison.title}", style="bold")
    console.print(summary(comparison.table))
    for remark in comparison.remarks:
        console.print(f"  {remark}")
    listed = _worst_first(comparison.table[comparison.table["outcome"] != "same"])
    if not listed.empty:
        shown = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="underline")
        for name in ("outcome", "experiment", "cell", "change"):
            shown.add_column(name, overflow="fold")
        for outcome, *texts in _readable(listed, _names(comparison.table)).head(PRINTED).to_numpy():
            shown.add_row(Text(outcome, "red" if outcome == "worse" else ""), *texts)
        console.print(shown)
    if len(listed) > PRINTED:
        console.print(f"and {len(listed) - PRINTED} more in the files")
    print("\nWritten:")
    for path in paths:
        print(f"  {path}")


def _worst_first(table: pd.DataFrame) -> pd.DataFrame:
    return table.iloc[table["outcome"].map(OUTCOMES.index).argsort(kind="stable")]


def _names(table: pd.DataFrame) -> list[str]:
    """Return the identity columns that distinguish the cells of a comparison."""
    return [column.name for column in identity_columns(table)]


def _cells(table: pd.DataFrame, names: Sequence[str]) -> list[str]:
    """Return a name for each cell, from some identity columns."""
    return [", ".join(filter(None, map(_named, names, row))) for row in table[list(names)].to_numpy(dtype=object)]


def _readable(table: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Return the changed cells as texts, each by some identity columns."""
    if table.empty:
        return pd.DataFrame({"outcome": [], "experiment": [], "cell": [], "change": []})
    return table[["outcome", "experiment"]].assign(cell=_cells(table, names), change=table["change"])


def _named(name: str, value: Any) -> str:
    if isinstance(value, str):
        return "" if value == "none" else value
    return f"{name}={axis_value(value)}" if math.isfinite(value) else ""


def page(comparison: Comparison) -> str:
    """Return the comparison as a page like that of an experiment."""
    table = _worst_first(comparison.table).reset_index(drop=True)
    rows = table.assign(series=table["outcome"], status=table["status_after"], reason=table["change"])
    numbers = [column for column in comparison.judged if column.kind == "number"]
    content = Content(
        finding=summary(table),
        rows=rows,
        columns=[
            Shown("outcome", "outcome", "text"),
            Shown("experiment", "experiment", "text"),
            *identity_columns(rows),
            *(
                Shown(f"{column.name}_{when}", f"{_called(column)} {when}", _kind(column))
                for column in comparison.judged
                for when in ("before", "after")
            ),
            *STATUS,
        ],
        charts=[_before_after(column) for column in numbers if rows[f"{column.name}_after"].notna().any()],
        answers=pd.DataFrame({"remark": [*comparison.remarks, *NOTES, timings.NOTE]}),
        answers_title="How it was judged",
        looks=LOOKS,
    )
    study = registry.make("studies", comparison.study)
    as_experiment = Experiment(
        name=comparison.title, study=study, columns=study.columns, choices={}, question="Did something get worse?"
    )
    return assemble(as_experiment, content, [[] for _ in range(len(rows))], {})


def _called(column: Column) -> str:
    return column.comparison.called if column.comparison else column.name


def _kind(column: Column) -> str:
    return "text" if column.kind == "text" else "seconds" if column.unit == "s" else "number"


def _before_after(column: Column) -> Chart:
    unit = f" [{column.unit}]" if column.unit else ""
    return Chart(
        f"{_called(column)}{unit}".capitalize(), "Points above the diagonal are larger after.",
        [PlotAxis(f"{column.name}_before", "before")], [PlotAxis(f"{column.name}_after", "after")], facet="experiment",
    )  # fmt: skip
