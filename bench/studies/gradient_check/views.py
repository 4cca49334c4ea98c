"""What the gradient check shows: which gradients are the derivatives of their programs' costs, and how to repeat faults."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import pandas as pd

from bench.experiment.axes import with_axes
from bench.experiment.columns import COMMON, Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import parse
from bench.experiment.views import Chart, Style, Table, Views
from bench.measure.gradcheck import FAULTS, MEANING, TRUSTED, UNDECIDED, VERDICTS
from bench.report.problems import axes_of, label_columns, problem_names, titled
from bench.report.style import PALETTE
from bench.report.text import counted, listed
from bench.report.views import Arranged, arrange
from bench.studies.gradient_check.lines import (
    PROBLEM,
    by_point,
    component_table,
    long_table,
    untrusted,
)
from bench.studies.gradient_check.points import POINTS

KINDS: dict[str, tuple[tuple[str, ...], Style]] = {
    "X": (FAULTS, Style(PALETTE[2], letter="X", meaning="X: not the derivative of its cost")),
    "?": (UNDECIDED, Style("#bdbdbd", letter="?", meaning="?: undecided")),
    "J": (("jump", "missed_slope"), Style(PALETTE[4], letter="J", meaning="J: the cost jumps or rises steeply here")),
    "K": (("kink",), Style(PALETTE[5], letter="K", meaning="K: kink, at most a one-sided slope")),
    "ok": (TRUSTED, Style("#cfe8df", letter="ok", meaning="ok: right")),
}
"""Verdicts and look of each letter in a cell, the worst first."""
LOOKS = {
    point: Style(PALETTE[place], marker) for point, place, marker in zip(POINTS, (0, 5, 2, 3, 4), "osD^X", strict=True)
}
"""Look of each point at which gradients are checked."""
RESOLVED = 0.1
"""Largest error of a right gradient that a difference shows; above it, a second method has confirmed the gradient."""
ERROR = Column("error", label="best error")
EPS = Column("eps", label="best eps")


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return how many gradients can be trusted, a line per problem and point, the checks, and the grid of verdicts."""
    shown = arrange(experiment, rows)
    points = by_point(shown.rows)
    names = problem_names(shown, PROBLEM, axes_of(shown, "horizon"), ("scene", "contact"))
    points = points.assign(name=names.to_numpy()[points["row"].astype(int)])
    tables = [
        Table("gradient_check", *_lines(shown, points), data=long_table(with_axes(experiment, rows)),
              title="gradients against differences of the cost", notes=_notes(rows, untrusted(points))),
        Table("gradient_components", component_table(rows), [], files=["csv"]),
    ]  # fmt: skip
    charts = [] if points.empty else [_grid(points), _errors(shown)]
    answers = Table("gradient_verdicts", *_verdicts(points), title="Verdicts", files=[], page=True)
    shown_columns = [experiment.columns.by_name[name] for name in ("verdict", "best_error", "best_eps")]
    return Views(
        [answers, *tables],
        charts,
        shown.rows,
        shown_columns,
        [*_tally(points), *_remarks(rows, points)],
    )


# ------------------------------------------------------------------------------------------------------- tables


def _lines(shown: Arranged, points: pd.DataFrame) -> tuple[pd.DataFrame, list[Column]]:
    """Return a line per problem, horizon, point and verdict with the worst error over backends and checks; the columns."""
    always = (*PROBLEM, "horizon")
    labels = [*always, *(name for name in label_columns(shown, PROBLEM, always=always) if name not in always)]
    lines = []
    for _, group in points.groupby(["problem", "point", "verdict"], sort=False):
        worst = group.loc[group["error"].idxmax()] if group["error"].notna().any() else group.iloc[0]
        cell = shown.rows.iloc[int(worst["row"])]
        lines.append({name: cell[name] for name in labels} | worst[["point", "verdict", "error"]].to_dict() | {
            "backends": ", ".join(dict.fromkeys(group["backend"])), "eps": f"{worst['eps']:.0e}"
        })  # fmt: skip
    columns = [
        *(COMMON.get(name, Column(name, format="setting")) for name in labels), text("point"), text("backends"),
        text("verdict"), ERROR, EPS,
    ]  # fmt: skip
    return pd.DataFrame(lines, columns=[column.name for column in columns]), columns


def _verdicts(points: pd.DataFrame) -> tuple[pd.DataFrame, list[Column]]:
    """Return a line per verdict: its meaning, the number of points, the largest error and the scenes; and the columns."""
    lines = [
        {
            "verdict": verdict, "meaning": MEANING[verdict], "trusted": "yes" if untrusted(part).empty else "no",
            "points": len(part), "error": part["error"].max(), "scenes": ", ".join(dict.fromkeys(part["scene"])),
        }
        for verdict in VERDICTS if len(part := points[points["verdict"] == verdict])
    ]  # fmt: skip
    largest = Column("error", label="largest error")
    columns = [
        text("verdict"),
        text("meaning"),
        text("trusted"),
        Column("points", format="setting"),
        largest,
        text("scenes"),
    ]
    return pd.DataFrame(lines, columns=[column.name for column in columns]), columns


def _notes(rows: pd.DataFrame, faults: pd.DataFrame) -> list[str]:
    """Return the paragraphs below the table: its columns, what was not checked, and the command that repeats each fault."""
    distances = dict.fromkeys(given["study"]["aside"] for given in parse(rows) if given)
    notes = [
        "- best error: |a - b| / max(1, |a|, |b|) between derivative and central difference, the smallest over all eps. "
        "Each line has the largest of its directions, samples and backends. eps is relative to max(1, |theta|).",
        f"- verdict: the worst of a line's checks. before and after are {' or '.join(map(_power, distances))} from a "
        "switch of contact mode, at is on it.",
    ]
    unchecked = rows[rows["status"] != "ok"].groupby("reason", sort=False)
    lines = [f"- {len(part)} {part['status'].iloc[0]}: {reason}" for reason, part in unchecked]
    notes += ["Not checked:", *lines] if lines else []
    if len(faults):
        notes.append("Gradients that cannot be trusted, and the command that repeats each:")
        for command, part in faults.groupby("command", sort=False):
            notes += [f"- {', '.join(dict.fromkeys(part['verdict']))}", f"      {command}"]
    switches = [f"- {line}" for line in _switches(rows)]
    notes += ["Contact switches with checks on both sides:", *switches] if switches else []
    remarks = [f"- {reason} ({counted(count, 'cell')})" for reason, count in _count_reasons(rows, True)]
    return [*notes, *(["Remarks:", *remarks] if remarks else [])]


def _power(value: float) -> str:
    """Format a value as ``1e-4``."""
    mantissa, _, power = f"{value:e}".partition("e")
    return f"{float(mantissa):g}e{int(power)}"


def _tally(points: pd.DataFrame) -> list[str]:
    """Return a line per problem with its counts of verdicts at each point."""
    lines = []
    for name, part in points.groupby("name", sort=False):
        counts = {point: Counter(part.loc[part["point"] == point, "verdict"]) for point in POINTS}
        texts = [
            f"{point} " + ", ".join(f"{tally[verdict]} {verdict}" for verdict in VERDICTS if verdict in tally)
            for point, tally in counts.items() if tally
        ]  # fmt: skip
        lines.append(f"  {name}: {'; '.join(texts)}")
    return lines


def _remarks(rows: pd.DataFrame, points: pd.DataFrame) -> list[str]:
    """Return the untrusted checks with the command that repeats each, and the reasons in the rows."""
    switches = _switches(rows)
    lines = ["\nContact switches with checks on both sides:", *(f"  {line}" for line in switches)] if switches else []
    for command, part in untrusted(points).groupby("command", sort=False):
        at = part.groupby("verdict", sort=False)["point"]
        verdicts = [f"{verdict} ({', '.join(dict.fromkeys(points))})" for verdict, points in at]
        lines.append(f"\n{', '.join(verdicts)}; repeat with\n  {command}")
    return [*lines, *(f"\n{counted(count, 'cell')}: {reason}" for reason, count in _count_reasons(rows))]


def _switches(rows: pd.DataFrame) -> list[str]:
    """Return a line per problem, backend and horizon with the contact switches that were checked."""
    lines = []
    for row in rows.to_dict("records"):
        every = row["contact_switch"] if "contact_switch" in rows else []
        names = [] if isinstance(every, float) else dict.fromkeys(name for name in every if name)  # NaN: an older row
        if names:
            problem = ", ".join([row["scene"], row["contact"], row["backend"], counted(int(row["horizon"]), "step")])
            lines.append(f"{problem}: {listed(names)}")
    return list(dict.fromkeys(lines))


def _count_reasons(rows: pd.DataFrame, of_checked: bool = False) -> Sequence[tuple[str, int]]:
    """Return each distinct reason, preceded by the status of failed cells, with its number of cells."""
    given = rows[(rows["reason"].fillna("") != "") & ((rows["status"] == "ok") | (not of_checked))]
    texts = given["reason"].where(given["status"] == "ok", given["status"] + ": " + given["reason"])
    return [(str(reason), int(count)) for reason, count in texts.value_counts(sort=False).items()]


# ------------------------------------------------------------------------------------------------------- charts


def _grid(points: pd.DataFrame) -> Chart:
    """Return the main chart: the worst verdict of each problem at each horizon and point, over backends and checks."""
    letters = {verdict: letter for letter, (verdicts, _) in KINDS.items() for verdict in verdicts}
    names = {name: place for place, name in enumerate(dict.fromkeys(points["name"]))}
    frame = points.assign(
        letter=points["verdict"].map(letters), place=points["point"].map(POINTS.index), order=points["name"].map(names),
        steps=[counted(int(horizon), "step") if horizon > 0 else "no steps" for horizon in points["horizon"]],
    ).sort_values(["rank", "error"], ascending=[True, False], kind="stable")  # fmt: skip
    frame = frame.drop_duplicates(["name", "horizon", "point"]).sort_values(
        ["horizon", "place", "order"], kind="stable"
    )
    switches = "Blank: no switch of contact was found." if frame["point"].nunique() > 1 else ""
    return Chart(
        "gradient_check", frame, [text("point", label="")], [text("name", label="")], "grid",
        panel="steps", level="letter", cell="letter", styles={letter: style for letter, (_, style) in KINDS.items()},
        height=0.17, subtitle=switches,
        text="The worst verdict over backends and checks: at the start, and before, at and after a switch of contact mode.",
    )  # fmt: skip


def _errors(shown: Arranged) -> Chart:
    """Return the chart of the page: the error of each check against the step of the differences."""
    parts = [*PROBLEM, "backend"]
    rows = shown.rows.assign(
        row=range(len(shown.rows)),
        problem=problem_names(shown, parts, axes_of(shown, "horizon"), parts),
        cell=problem_names(shown, ["scene"], always=["horizon"]),
    )
    long = long_table(rows)
    long = long[long["eps"].notna()]
    frame = long.assign(check=titled(long, ["point", "sample", "direction", "cell"]), row=long["row"].astype(int))
    frame = frame.astype({"eps": float, "relative_error": float})
    return Chart(
        "gradient_errors", frame,
        [Column("eps", label="eps, in units of the natural scale", log=True)],
        [Column("relative_error", log=True, above_one="larger than the gradient")], series="point", line="check", panel="problem",
        styles=LOOKS, printed=False, text="That of a wrong gradient stays constant.",
    )  # fmt: skip
