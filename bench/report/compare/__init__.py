"""Two sets of results held against each other, cell by cell: did something get worse?"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.errors import UserError, unknown
from bench.grid import Experiment
from bench.report.compare.changes import COLUMNS, NOTES, compared
from bench.report.compare.sources import Results, opened
from bench.report.tables import plain_markdown
from bench.report.views import axis_value
from bench.report.web.content import STATUS, Axis, Chart, Column, Content, counted, identity_columns, look
from bench.report.web.document import assemble
from bench.store import write_whole

SETTINGS = ("timings", "out")
PRINTED = 30
"""Most changes that are printed; the files have all."""
LOOKS = {
    "worse": look("#D55E00", "triangle-up"),
    "better": look("#0072B2", "triangle-down"),
    "changed": look("#CC79A7", "square"),
    "same": look("#7F6000", "circle"),
}


def main(words: Sequence[str]) -> int:
    """Compare the two results named in ``words``; 1 when something got worse. Raises :class:`UserError` for bad input."""
    before, after, timings, out = _parsed(words)
    with opened(before) as old, opened(after) as new:
        shared = [name for name in old if name in new]
        if not shared:
            raise UserError(f"{before} ({_names(old)}) and {after} ({_names(new)}) have no experiment in common")
        remarks = [
            f"{name} is only in {side}: not compared"
            for side, mine, other in ((before, old, new), (after, new, old))
            for name in mine
            if name not in other
        ]
        parts = []
        for name in shared:
            same = bool(old[name].machine) and old[name].machine == new[name].machine
            remarks += [f"{name}: {remark}" for remark in timing_remarks(old[name], new[name], same, timings)]
            parts.append(compared(old[name].rows, new[name].rows, timings or same).assign(experiment=name))
    table = pd.concat(parts, ignore_index=True)
    paths = _write(out, f"{before} against {after}", table, remarks)
    _show(before, after, table, remarks)
    print("\nWritten:")
    for path in paths:
        print(f"  {path}")
    return 1 if (table["outcome"] == "worse").any() else 0


def _parsed(words: Sequence[str]) -> tuple[str, str, bool, Path]:
    names, settings = [], {"timings": "false", "out": "runs/compare"}
    for word in words:
        key, equals, value = word.partition("=")
        if word == "--timings":
            settings["timings"] = "true"
        elif equals and not key.startswith("-") and "/" not in key:
            if key not in SETTINGS:
                raise unknown("setting of compare", key, SETTINGS)
            settings[key] = value
        else:
            names.append(word)
    if len(names) != 2:
        raise UserError(
            "name two results: python -m bench compare BEFORE AFTER (directories, or revisions as REV or REV:PATH)"
        )
    if settings["timings"] not in ("true", "false"):
        raise unknown("value for timings:", settings["timings"], ("true", "false"))
    return names[0], names[1], settings["timings"] == "true", Path(settings["out"]).expanduser()


def _names(results: dict[str, Results]) -> str:
    return ", ".join(results)


def timing_remarks(old: Results, new: Results, same: bool, timings: bool) -> list[str]:
    """Why times are not compared, or why they should be read with care."""
    remarks = []
    if not same:
        told = f"timings of different machines ({old.machine or 'unknown'}; {new.machine or 'unknown'})"
        remarks.append(
            f"WARNING: {told} are compared" if timings else f"{told} are not compared: add --timings to do so"
        )
    if same or timings:
        for when, results in (("before", old), ("after", new)):
            if results.busy:
                remarks.append(f"WARNING: the machine was busy {when} ({results.busy}), so timings are doubtful")
    return remarks


# -------------------------------------------------------------------------------------------------------- output


def summary(table: pd.DataFrame) -> str:
    """``3 of 560 cells got worse: ...``."""
    counts = table["outcome"].value_counts()
    parts = [f"{counts.get(kind, 0)} got {kind}" for kind in ("worse", "better")]
    text = f"{', '.join(parts)}, {counts.get('same', 0)} are the same within what was measured"
    worse = table.loc[table["outcome"] == "worse", "change"]
    changes = Counter(change.partition(" ")[0] for text in worse for change in text.split("; "))
    most = ", ".join(f"{count} in {kind}" for kind, count in changes.most_common())
    return f"Of {counted(len(table), 'cell')} {text}" + (f"; of the worse, {most}." if most else ".")


def _write(out: Path, title: str, table: pd.DataFrame, remarks: Sequence[str]) -> list[Path]:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"'{out}' cannot be written: {error.strerror}") from None
    listed = table[table["outcome"] != "same"]
    texts = [
        f"# {title}",
        summary(table),
        *remarks,
        plain_markdown(_readable(listed)),
        *(f"- {note}" for note in NOTES),
    ]
    contents = {
        "compare.csv": table[["experiment", *COLUMNS]].to_csv(index=False, lineterminator="\n"),
        "compare.md": "\n\n".join(texts) + "\n",
        "compare.html": _page(title, table, remarks),
    }
    for name, text in contents.items():
        write_whole(out / name, text.encode())
    return [out / name for name in contents]


def _readable(table: pd.DataFrame) -> pd.DataFrame:
    """The changed cells as texts."""
    if table.empty:
        return pd.DataFrame({"outcome": [], "cell": [], "change": []})
    names = [column.name for column in identity_columns(table)]
    cells = [", ".join(filter(None, map(_named, names, row))) for row in table[names].to_numpy(dtype=object)]
    return table[["outcome", "experiment"]].assign(cell=cells, change=table["change"])


def _named(name: str, value: Any) -> str:
    if isinstance(value, str):
        return "" if value == "none" else value
    return f"{name}={axis_value(value)}" if math.isfinite(value) else ""


def _show(before: str, after: str, table: pd.DataFrame, remarks: Sequence[str]) -> None:
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = max(console.width, 160)
    console.print(f"\n{before} against {after}", style="bold")
    console.print(summary(table))
    for remark in remarks:
        console.print(f"  {remark}")
    listed = table[table["outcome"] != "same"].sort_values(
        "outcome", key=lambda kinds: kinds.map(list(LOOKS).index), kind="stable"
    )
    if listed.empty:
        return
    shown = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="underline")
    for name in ("outcome", "experiment", "cell", "change"):
        shown.add_column(name, overflow="fold")
    for outcome, *texts in _readable(listed).head(PRINTED).to_numpy():
        shown.add_row(Text(outcome, "red" if outcome == "worse" else ""), *texts)
    console.print(shown)
    if len(listed) > PRINTED:
        console.print(f"and {len(listed) - PRINTED} more in the files")


def _page(title: str, table: pd.DataFrame, remarks: Sequence[str]) -> str:
    """The comparison as a page like that of an experiment."""

    def before_after(name: str, text: str) -> Chart:
        return Chart(text, "Points above the diagonal are larger after.", [Axis(f"{name}_before", "before")],
                     [Axis(f"{name}_after", "after")], facet="experiment")  # fmt: skip

    measured = {"bias_rel": "Relative bias", "rmse_rel": "Relative RMSE", "time_s": "Time of one estimate [s]"}
    rows = table.assign(series=table["outcome"], status=table["status_after"], reason=table["change"])
    rows = rows.iloc[rows["outcome"].map(list(LOOKS).index).argsort(kind="stable")].reset_index(drop=True)
    content = Content(
        finding=summary(table),
        rows=rows,
        columns=[
            Column("outcome", "outcome", "text"),
            Column("experiment", "experiment", "text"),
            *identity_columns(rows),
            *(Column(f"{name}_{when}", f"{name} {when}") for name in measured for when in ("before", "after")),
            *STATUS,
        ],
        charts=[before_after(name, text) for name, text in measured.items() if rows[f"{name}_after"].notna().any()],
        answers=pd.DataFrame({"remark": [*remarks, *NOTES]}),
        answers_title="How it was judged",
        looks=LOOKS,
    )
    made = Experiment(name=title, choices={}, question="Did something get worse?")
    return assemble(made, content, [[] for _ in range(len(rows))], {})
