"""Writes gradient checks: tables by check and by component, and a summary with the command that repeats each fault."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import with_axes
from bench.experiment.columns import IDENTITY
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import parse
from bench.measure.gradcheck import VERDICTS
from bench.report.problems import axes_of, problem_names, problem_numbers, value_text
from bench.report.study_tables import label_columns, open_console
from bench.report.tables import escape_markdown, plain_markdown
from bench.report.text import counted, number
from bench.report.views import Arranged, arrange
from bench.run.files import write_all
from bench.studies.gradient_check.columns import COLUMNS
from bench.studies.gradient_check.points import POINTS, is_trusted

PER_CHECK = ["point", "sample", "direction", "derivative_program"]
PER_STEP = ["derivative_differences", "relative_error", "mode_minus", "mode_plus"]
PER_COMPONENT = (
    "component", "component_program", "component_difference", "component_uncertainty", "component_step",
    "component_ratio", "component_left", "component_right", "component_verdict",
)  # fmt: skip
PROBLEM = ("scene", "contact", "integrator")
"""Parts of the grid that identify a problem."""


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``gradient_check`` (.csv, .md) and ``gradient_components.csv``; return the files' paths."""
    shown = arrange(experiment, rows)
    table = long_table(with_axes(experiment, rows))
    contents = {
        "gradient_check.csv": table.to_csv(index=False, lineterminator="\n"),
        "gradient_check.md": markdown(shown),
        "gradient_components.csv": component_table(rows).to_csv(index=False, lineterminator="\n"),
    }
    return write_all(experiment.directory, contents)


# ------------------------------------------------------------------------------------------------------ tables


def checks(rows: pd.DataFrame) -> Iterator[tuple[dict[str, Any], int, str]]:
    """Yield each check of each row: the row, the number of the check within it, and the verdict."""
    for row in rows.to_dict("records"):
        for i, verdict in enumerate(row["check_verdict"]):
            yield {str(name): value for name, value in row.items()}, i, verdict


def long_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell, check and eps, and one line per cell that could not be checked.

    Columns that are not the study's own, such as swept parameters, are last. The column ``parameters`` is omitted,
    since it would be repeated on every line: ``rows.parquet`` has it under the same ``key``.
    """
    whole = ["experiment", *IDENTITY, "dim", "status", "reason"]
    added = [name for name in rows if name not in COLUMNS.by_name]
    last = list(dict.fromkeys(["key", *map(str, added), *(name for name in ("study",) if name in rows)]))
    lines = []
    for row, i, verdict in checks(rows):
        check = {name: row[name] for name in whole} | {name: row[name][i] for name in PER_CHECK}
        end = {"verdict": verdict} | {name: row[name] for name in last}
        count = len(row["eps"])
        for k in range(count):
            values = {name: row[name][i * count + k] for name in PER_STEP}
            lines.append(check | {"eps": row["eps"][k]} | values | end)
    unchecked = rows[[len(verdicts) == 0 for verdicts in rows["check_verdict"]]]
    lines += unchecked[[*whole, "verdict", *last]].to_dict("records")
    table = pd.DataFrame(lines, columns=[*whole, *PER_CHECK, "eps", *PER_STEP, "verdict", *last])
    counts = ["horizon", "samples", "repeats", "dim", "seed", "sample", "direction"]
    return table.astype(dict.fromkeys(counts, "Int64"))


def component_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell and component of theta, with the columns :data:`PER_COMPONENT`."""
    names = ["experiment", *IDENTITY, "dim"]
    lines = [
        {name: row[name] for name in names} | dict(zip(PER_COMPONENT, values, strict=True)) | {"key": row["key"]}
        for row in rows.to_dict("records")
        for values in zip(*(row[name] for name in PER_COMPONENT), strict=True)
    ]
    return pd.DataFrame(lines, columns=[*names, *PER_COMPONENT, "key"])


def by_point(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell and point: its worst verdict, and the largest error among its checks, with the eps.

    The error of a check is the smallest over all eps. ``row`` is the position of the cell in ``rows``. ``problem`` is a
    number, the same for cells with equal parameters of scene, contact law and integrator.
    """
    lines = []
    shown = ("scene", "contact", "integrator", "backend", "horizon", "dtype", "key", "command")
    for row, i, verdict in checks(rows.assign(row=range(len(rows)), problem=problem_numbers(rows, PROBLEM))):
        cell = {name: row[name] for name in (*shown, "row", "problem")}
        result = {"verdict": verdict, "error": row["check_error"][i], "eps": row["check_eps"][i]}
        lines.append(cell | {"point": row["point"][i], "rank": VERDICTS.index(verdict)} | result)
    names = [*shown, "row", "problem", "point", "verdict", "error", "eps", "rank"]
    table = pd.DataFrame(lines, columns=names)
    table = table.sort_values(["rank", "error"], ascending=[True, False], kind="stable")
    return table.drop_duplicates(["row", "point"]).sort_index()


def markdown(shown: Arranged) -> str:
    """Return the report as Markdown: a line per problem, point and verdict, then the command that repeats each fault."""
    rows, summary = shown.rows, by_point(shown.rows)
    title = shown.experiment.question or shown.experiment.name
    always = (*PROBLEM, "horizon")
    labels = label_columns(shown, PROBLEM, always=always)
    labels = [*always, *(name for name in labels if name not in always)]
    lines = []
    for _, group in summary.groupby(["problem", "point", "verdict"], sort=False):
        worst = group.loc[group["error"].idxmax()] if group["error"].notna().any() else group.iloc[0]
        backends = ", ".join(dict.fromkeys(group["backend"]))
        cells = [value_text(rows[name].iloc[worst["row"]]) for name in labels]
        lines.append(
            [*cells, worst["point"], backends, worst["verdict"], number(worst["error"]), f"{worst['eps']:.0e}"]
        )
    heads = [*labels, "point", "backends", "verdict", "best error", "best eps"]
    out = [f"# {escape_markdown(title)}", "", plain_markdown(pd.DataFrame(lines, columns=heads)), ""]
    out += [
        "- best error: |a - b| / max(1, |a|, |b|) between derivative and central difference, the smallest over all eps. "
        "Each line has the largest of its directions, samples and backends. eps is relative to max(1, |theta|).",
        f"- verdict: the worst of a line's checks. `before` and `after` are {distance(rows)} from a switch of contact "
        "mode, `at` is on it.",
    ]
    unchecked = rows[rows["status"] != "ok"]
    if not unchecked.empty:
        out += ["", "Not checked:", ""]
        for reason, part in unchecked.groupby("reason", sort=False):
            out.append(f"- {len(part)} {part['status'].iloc[0]}: {escape_markdown(str(reason))}")
    faults = untrusted(summary)
    if not faults.empty:
        out += ["", "Gradients that cannot be trusted, and the command that repeats each:", ""]
        for line, part in faults.groupby("command", sort=False):
            out += [f"- {', '.join(dict.fromkeys(part['verdict']))}", "", f"      {line}", ""]
    remarks = count_reasons(rows[rows["status"] == "ok"])
    if remarks:
        out += ["", "Remarks:", ""]
        out += [f"- {escape_markdown(text)} ({counted(count, 'cell')})" for text, count in remarks]
    return "\n".join(out).rstrip("\n") + "\n"


def distance(rows: pd.DataFrame) -> str:
    """Format how far before and after a contact switch the rows were checked: the ``aside`` of their studies."""
    distances = dict.fromkeys(given["study"]["aside"] for given in parse(rows) if given)
    return " or ".join(_power(value) for value in distances)


def _power(value: float) -> str:
    """Format a value as ``1e-4``."""
    mantissa, _, power = f"{value:e}".partition("e")
    return f"{float(mantissa):g}e{int(power)}"


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print each problem's counts of verdicts, and the command that repeats each untrusted check."""
    open_console(experiment, rows)
    shown = arrange(experiment, rows)
    names = problem_of(shown)
    summary = by_point(rows)
    for name, part in summary.groupby(names.to_numpy()[summary["row"].astype(int)], sort=False):
        parts = []
        for point in POINTS:
            tally = Counter(part["verdict"][part["point"] == point])
            if tally:
                parts.append(f"{point} " + ", ".join(f"{tally[v]} {v}" for v in VERDICTS if v in tally))
        print(f"  {name}: " + "; ".join(parts))
    faults = untrusted(summary)
    for line, lines in faults.groupby("command", sort=False):
        parts = lines.groupby("verdict", sort=False)["point"]
        verdicts = [f"{verdict} ({', '.join(dict.fromkeys(points))})" for verdict, points in parts]
        print(f"\n{', '.join(verdicts)}; repeat with\n  {line}")
    for text, count in count_reasons(rows):
        print(f"\n{counted(count, 'cell')}: {text}")


def untrusted(summary: pd.DataFrame) -> pd.DataFrame:
    """Return the lines of :func:`by_point` whose gradient cannot be trusted."""
    pairs = zip(summary["point"], summary["verdict"], strict=True)
    return summary[np.array([not is_trusted(point, verdict) for point, verdict in pairs], dtype=bool)]


def count_reasons(rows: pd.DataFrame) -> list[tuple[str, int]]:
    """Return each distinct reason, preceded by the status of failed cells, with its number of cells."""
    given = rows[rows["reason"].fillna("") != ""]
    texts = given["reason"].where(given["status"] == "ok", given["status"] + ": " + given["reason"])
    return [(str(text), int(count)) for text, count in texts.value_counts(sort=False).items()]


def problem_of(shown: Arranged) -> pd.Series:
    """Return, per row, the name of its problem, which is the same at every horizon."""
    return problem_names(shown, PROBLEM, axes_of(shown, "horizon"), ("scene", "contact"))
