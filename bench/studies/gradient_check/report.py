"""Writes gradient checks as files: a long table, and a summary with the command that repeats each fault."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import parsed, with_axes
from bench.experiment.columns import IDENTITY
from bench.experiment.experiment import Experiment
from bench.measure.gradcheck import VERDICTS
from bench.report.tables import escape_markdown
from bench.report.text import counted, number
from bench.report.views import Arranged, arranged
from bench.report.web.content import columns_of, distinguishing_columns, grouped, problems, shown_as, together
from bench.run.files import write_all
from bench.studies.gradient_check import GradientCheck
from bench.studies.gradient_check.places import trusted

POINTS = ("start", "before", "at", "after")
"""The points at which gradients are checked."""
CHECK = ["point", "sample", "direction", "derivative_program"]
EACH = ["derivative_differences", "relative_error", "mode_minus", "mode_plus"]
ORDER = [*CHECK, "eps", *EACH, "verdict"]
PROBLEM = ("scene", "contact", "integrator")


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``gradient_check`` (.csv, .md) and ``gradient_components.csv``; returns the files' paths."""
    shown = arranged(experiment, rows)
    table = long_table(with_axes(experiment, rows))
    contents = {
        "gradient_check.csv": table.to_csv(index=False, lineterminator="\n"),
        "gradient_check.md": markdown(shown),
        "gradient_components.csv": component_table(rows).to_csv(index=False, lineterminator="\n"),
    }
    return write_all(experiment.directory, contents)


# ------------------------------------------------------------------------------------------------------ tables


def checks(rows: pd.DataFrame) -> Iterator[tuple[dict[str, Any], int, str]]:
    """Yield each check of each row: the row, the number of the check in it, and its verdict."""
    for row in rows.to_dict("records"):
        for i, verdict in enumerate(row["check_verdict"]):
            yield {str(name): value for name, value in row.items()}, i, verdict


def long_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell, check and eps; one line for a cell that could not be checked.

    Columns that belong to no study, such as swept parameters, come last. The cell's parameters are in ``rows.parquet``
    under its key; here they would be on every line.
    """
    whole = ["experiment", *IDENTITY, "dim", "status", "reason"]
    added = [name for name in rows if name not in GradientCheck.columns.by_name]
    last = list(dict.fromkeys(["key", *map(str, added), *(name for name in ("study",) if name in rows)]))
    lines = []
    for row, i, verdict in checks(rows):
        check = {name: row[name] for name in whole} | {name: row[name][i] for name in CHECK}
        end = {"verdict": verdict} | {name: row[name] for name in last}
        count = len(row["eps"])
        for k in range(count):
            values = {name: row[name][i * count + k] for name in EACH}
            lines.append(check | {"eps": row["eps"][k]} | values | end)
    unchecked = rows[[len(verdicts) == 0 for verdicts in rows["check_verdict"]]]
    lines += unchecked[[*whole, "verdict", *last]].to_dict("records")  # type: ignore[arg-type]
    table = pd.DataFrame(lines, columns=[*whole, *ORDER, *last])
    counts = ["horizon", "samples", "repeats", "dim", "seed", "sample", "direction"]
    return table.astype(dict.fromkeys(counts, "Int64"))


PART = (
    "component", "component_program", "component_difference", "component_uncertainty", "component_step",
    "component_ratio", "component_left", "component_right", "component_verdict",
)  # fmt: skip
"""Columns that hold a value per component."""


def component_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell and component of theta, with a column for each of :data:`PART`."""
    names = ["experiment", *IDENTITY, "dim"]
    lines = [
        {name: row[name] for name in names} | dict(zip(PART, values, strict=True)) | {"key": row["key"]}
        for row in rows.to_dict("records")
        for values in zip(*(row[name] for name in PART), strict=True)
    ]
    return pd.DataFrame(lines, columns=[*names, *PART, "key"])


def by_point(rows: pd.DataFrame) -> pd.DataFrame:
    """Merge the checks of each cell and point into one line: the worst verdict, the largest best error with its eps.

    ``row`` is the position of the cell in ``rows``; ``problem`` is the same number where scene, contact law and
    integrator have the same parameters.
    """
    lines = []
    shown = ("scene", "contact", "integrator", "backend", "horizon", "dtype", "key", "command")
    for row, i, verdict in checks(rows.assign(row=range(len(rows)), problem=grouped(rows, PROBLEM))):
        cell = {name: row[name] for name in (*shown, "row", "problem")}
        result = {"verdict": verdict, "error": row["check_error"][i], "eps": row["check_eps"][i]}
        lines.append(cell | {"point": row["point"][i], "rank": VERDICTS.index(verdict)} | result)
    names = [*shown, "row", "problem", "point", "verdict", "error", "eps", "rank"]
    table = pd.DataFrame(lines, columns=names)
    table = table.sort_values(["rank", "error"], ascending=[True, False], kind="stable")
    first = table.drop_duplicates(["row", "point"])
    return first.sort_index()


def markdown(shown: Arranged) -> str:
    """Write the verdict of each cell and point, agreeing backends on one line, and commands that repeat each fault."""
    rows, summary = shown.rows, by_point(shown.rows)
    title = shown.experiment.question or shown.experiment.name
    out = [f"# {escape_markdown(title)}", ""]
    always = (*PROBLEM, "horizon")
    named = distinguishing_columns(rows, grouped(rows, PROBLEM), columns_of(shown, PROBLEM), always)
    named = [*always, *(name for name in named if name not in always)]
    headers = [*named, "point", "backends", "verdict", "best error", "best eps"]
    texts = [rows[name].map(type).eq(str).all() for name in named]
    out.append("| " + " | ".join(headers) + " |")
    out.append("|" + "".join("---|" if text else "--:|" for text in texts) + "---|---|---|--:|--:|")
    groups = summary.groupby(["problem", "point", "verdict"], sort=False)
    for _, group in groups:
        worst = group.loc[group["error"].idxmax()] if group["error"].notna().any() else group.iloc[0]
        backends = ", ".join(dict.fromkeys(group["backend"]))
        cells = [shown_as(rows[name].iloc[worst["row"]]) for name in named]
        cells += [worst["point"], backends, worst["verdict"], number(worst["error"]), f"{worst['eps']:.0e}"]
        out.append("| " + " | ".join(escape_markdown(cell) for cell in cells) + " |")
    out += [
        "",
        "- best error: the smallest |a - b| / max(1, |a|, |b|) of derivative and central differences over all eps; of the "
        "directions, samples and backends of a line the largest. eps is relative to max(1, |theta|).",
        f"- verdict: the worst of a line's checks. `before` and `after` are {aside(rows)} from a switch of contact mode, "
        "`at` is on it.",
    ]  # fmt: skip
    lost = rows[rows["status"] != "ok"]
    if not lost.empty:
        out += ["", "Not checked:", ""]
        for reason, part in lost.groupby("reason", sort=False):
            out.append(f"- {len(part)} {part['status'].iloc[0]}: {escape_markdown(str(reason))}")
    faults = doubtful(summary)
    if not faults.empty:
        out += ["", "Gradients that cannot be trusted, and the command that repeats each:", ""]
        for line, part in faults.groupby("command", sort=False):
            out += [f"- {', '.join(dict.fromkeys(part['verdict']))}", "", f"      {line}", ""]
    said = remarks(rows[rows["status"] == "ok"])
    if said:
        out += ["", "Remarks:", "", *(f"- {escape_markdown(text)} ({counted(count, 'cell')})" for text, count in said)]
    return "\n".join(out).rstrip("\n") + "\n"


def aside(rows: pd.DataFrame) -> str:
    """Write how far from a switch of contact mode rows were checked before and after it, as their study says."""
    distances = dict.fromkeys(given["study"]["aside"] for given in parsed(rows) if given)
    return " or ".join(_power(value) for value in distances)


def _power(value: float) -> str:
    """Write ``1e-4``: one digit and a power, if that writes the value exactly."""
    mantissa, _, power = f"{value:e}".partition("e")
    return f"{float(mantissa):g}e{int(power)}"


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the counts of verdicts of each problem, and a command that repeats each fault."""
    print(f"\n{experiment.name}: {experiment.question}" if experiment.question else f"\n{experiment.name}")
    counts = rows["status"].value_counts()
    print(f"{counted(len(rows), 'cell')}: " + ", ".join(f"{count} {status}" for status, count in counts.items()))
    shown = arranged(experiment, rows)
    names = problem_of(shown)
    summary = by_point(rows)
    for name, part in summary.groupby(names.to_numpy()[summary["row"].astype(int)], sort=False):
        parts = []
        for point in POINTS:
            tally = Counter(part["verdict"][part["point"] == point])
            if tally:
                parts.append(f"{point} " + ", ".join(f"{tally[v]} {v}" for v in VERDICTS if v in tally))
        print(f"  {name}: " + "; ".join(parts))
    faults = doubtful(summary)
    for line, lines in faults.groupby("command", sort=False):
        parts = lines.groupby("verdict", sort=False)["point"]
        named = [f"{verdict} ({', '.join(dict.fromkeys(points))})" for verdict, points in parts]
        print(f"\n{', '.join(named)}; repeat with\n  {line}")
    for text, count in remarks(rows):
        print(f"\n{counted(count, 'cell')}: {text}")


def doubtful(summary: pd.DataFrame) -> pd.DataFrame:
    """Return the lines of :func:`by_point` on which a gradient cannot be trusted."""
    pairs = zip(summary["point"], summary["verdict"], strict=True)
    return summary[np.array([not trusted(point, verdict) for point, verdict in pairs], dtype=bool)]


def remarks(rows: pd.DataFrame) -> list[tuple[str, int]]:
    """Return the reasons of cells, those of failed ones with their status, and how many have each."""
    told = rows[rows["reason"].fillna("") != ""]
    texts = told["reason"].where(told["status"] == "ok", told["status"] + ": " + told["reason"])
    return [(str(text), int(count)) for text, count in texts.value_counts(sort=False).items()]


def problem_of(shown: Arranged) -> pd.Series:
    """Return, per row, the name of its problem, the same at every horizon."""
    return problems(shown, PROBLEM, together(shown, "horizon"), ("scene", "contact"))
