"""Writes a comparison as files, and prints it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pandas as pd

from bench.compare import timings
from bench.compare.cells import FIRST, LAST, OUTCOMES, WORSE_IN, both_sides
from bench.compare.judging import NOTES
from bench.experiment.columns import Column
from bench.experiment.grid import COUNTS
from bench.experiment.parameters import flat_rows
from bench.report.problems import titled, varying_identity
from bench.report.tables import plain_markdown
from bench.report.text import counted, one_line
from bench.run.files import make_directory, write_all

PRINTED = 30
"""Largest number of printed changes. The files contain all changes."""
LISTED = 100
"""Largest number of changes in the Markdown file, which CI servers show above a run."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """All experiments that two results have in common, cell by cell."""

    title: str
    table: pd.DataFrame
    """The lines of :func:`bench.compare.cells.compare_cells`, with the column ``experiment``."""
    remarks: Sequence[str]
    judged: Sequence[Column]
    """The judged columns of all studies, each name once."""

    @property
    def worse(self) -> bool:
        """Whether some cell got worse."""
        return bool((self.table["outcome"] == "worse").any())

    def __str__(self) -> str:
        lines = [self.title, summary(self.table), *(f"  {remark}" for remark in self.remarks)]
        lines += [": ".join(map(str, line)) for line in self.changes.head(PRINTED).to_numpy()]
        lines += [f"and {len(self.changes) - PRINTED} more in the files"] * (len(self.changes) > PRINTED)
        return "\n".join(map(one_line, lines))

    __repr__ = __str__

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
        named = named[named["outcome"] != "same"]
        return named.iloc[named["outcome"].map(OUTCOMES.index).argsort(kind="stable")]


def summary(table: pd.DataFrame) -> str:
    """Return the number of cells by outcome, and in which columns how many got worse."""
    subjects = Counter(subject for subjects in table[WORSE_IN] for subject in subjects)
    reasons = ", ".join(f"{subject} {n}" for subject, n in subjects.most_common())
    counts = ", ".join(f"{count} {outcome}" for outcome, count in count_outcomes(table).items())
    return f"{counted(len(table), 'cell')}: {counts}{f'; worse in: {reasons}' if reasons else ''}"


def count_outcomes(table: pd.DataFrame) -> dict[str, int]:
    """Return the number of cells by outcome, the worst first."""
    return {outcome: int((table["outcome"] == outcome).sum()) for outcome in OUTCOMES}


def write(comparison: Comparison, out: Path) -> list[Path]:
    """Write ``compare`` as .csv and .md. Raises :class:`StorageError` if that fails."""
    make_directory(out)
    return write_all(
        out,
        {
            "compare.csv": comparison.to_frame().drop(columns="cell").to_csv(index=False, lineterminator="\n"),
            "compare.md": markdown(comparison),
        },
    )


def markdown(comparison: Comparison) -> str:
    """Return the summary, counts by experiment, remarks, first changes (the worst first) and rules as Markdown."""
    table, listed = comparison.table, comparison.changes
    by_experiment = pd.DataFrame(
        [{"experiment": str(name)} | count_outcomes(part) for name, part in table.groupby("experiment", sort=False)]
    ).astype(str)
    texts = [f"# {comparison.title}", summary(table), plain_markdown(by_experiment), *comparison.remarks]
    if not listed.empty:
        texts.append(plain_markdown(listed.head(LISTED)))
    if len(listed) > LISTED:
        texts.append(f"And {len(listed) - LISTED} more in `compare.csv`.")
    return "\n\n".join([*texts, "\n".join(f"- {note}" for note in (*NOTES, timings.NOTE))]) + "\n"


def cell_names(table: pd.DataFrame) -> list[str]:
    """Return a name for each cell: the identity columns that vary, and the parameters in which cells of one name differ."""
    table = table.reset_index(drop=True)
    names = titled(table, varying_identity(table))
    for _, part in table.groupby(["experiment", names], sort=False):
        if len(part) > 1:
            flat, lines = flat_rows(part)
            flat = flat.iloc[lines].set_axis([f"{plugin or axis}.{name}" for axis, plugin, name in flat], axis=1)
            every = flat.set_axis(part.index).assign(**part[[*COUNTS]])
            differing = every.loc[:, every.astype(str).nunique(dropna=False) > 1].map(
                lambda one: one if isinstance(one, str | int | float) else str(one)
            )
            names[part.index] = names[part.index] + ", " + titled(differing, [*differing])
    return [*names]
