"""What the gradient check shows: which gradients are the derivatives of their programs' costs, and how to repeat faults."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import with_axes
from bench.experiment.columns import COMMON, IDENTITY, Column, setting, text
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import PROBLEM
from bench.experiment.views import Chart, Style, Table, Views
from bench.gradient import BROKEN, FAULTS, RULES, TRUSTED, UNDECIDED, VERDICTS
from bench.report.names import short_names
from bench.report.problems import axes_of, label_columns, problem_names, problem_numbers
from bench.report.reproduce import own_plugins
from bench.report.style import PALETTE
from bench.report.text import counted, listed
from bench.report.views import Arranged, arrange
from bench.report.writer import reasons

from . import POINTS, GradientCheck, is_trusted

PER_CHECK = ["point", "sample", "direction", "derivative_program"]
PER_STEP = ["derivative_differences", "relative_error", "mode_minus", "mode_plus"]
PER_COMPONENT = [name for name in GradientCheck.columns.by_name if name.startswith("component")]
KINDS: dict[str, tuple[tuple[str, ...], Style]] = {
    "X": (FAULTS, Style(PALETTE[2], meaning="X: not the derivative of its cost")),
    "?": (UNDECIDED, Style("#bdbdbd", meaning="?: undecided")),
    "J": (("jump", "missed_slope"), Style(PALETTE[4], meaning="J: the cost jumps or rises steeply here")),
    "K": (("kink",), Style("#e8b96a", meaning="K: kink, at most a one-sided slope")),
    "ok": (TRUSTED, Style("#cfe8df", meaning="ok: right")),
}
"""Verdicts and look of each letter in a cell, the worst first."""
PLACES = dict(zip(POINTS, ("start", "before a switch", "at a switch", "after a switch", "under noise"), strict=True))
"""Where gradients are checked, in words; a switch is one of contact mode."""
ERROR = Column("error", label="best error")
EPS = Column("eps", label="best eps", digits=1)
NOTE = (
    "best error: |a - b| / max(1, |a|, |b|) between derivative and central difference, the smallest over all eps. Each line has "
    "the largest of its directions, samples and backends. eps is relative to max(1, |theta|). verdict: the worst of a line's "
    "checks. before and after are the study's `aside` from a switch of contact mode, at is on it. Below: commands that repeat faults."
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the verdicts, a line per problem and point, the checks, the grid of verdicts, and how to repeat faults."""
    shown = arrange(experiment, rows)
    points = by_point(shown.rows)
    names = problem_names(shown, PROBLEM, axes_of(shown, "horizon"), ("scene", "contact"))
    points = points.assign(name=names.to_numpy()[points["row"].astype(int)])
    faults = [
        line
        for command, part in untrusted(points).groupby("command", sort=False)
        for line in (_tally(part), " ".join([f"      {command}", *own_plugins(experiment)]))
    ]
    tables = [
        Table("gradient_verdicts", *_verdicts(points), title="Verdicts", files=[], page=True, terminal=True),
        Table(
            "gradient_check",
            *_lines(shown, points),
            data=long_table(with_axes(experiment.whole_sweep, rows)),
            title="gradients against differences of the cost",
            notes=[NOTE, *faults, *reasons(rows)],
        ),
        Table("gradient_components", component_table(rows)),
    ]
    charts = [] if points.empty else [_grid(points)]
    columns = [experiment.columns.by_name[name] for name in ("verdict", "best_error", "best_eps")]
    switches = dict.fromkeys(f"contact switch: {name}" for names in rows["contact_switch"] for name in _switches(names))
    return Views(tables, charts, shown.rows, columns, [*switches, *faults], headline(rows))


def headline(rows: pd.DataFrame) -> str:
    """Return in how many cells estimates can be trusted; empty for older rows, which do not say so."""
    given = rows["trusted"][rows["trusted"] != ""]
    return f"trusted: {', '.join(f'{n} {answer}' for answer, n in given.value_counts().items())}" if len(given) else ""


# ------------------------------------------------------------------------------------------------------- lines


def checks(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per check with the columns of its row; ``row`` is the position of the row."""
    split = {
        name: [
            np.array_split(np.asarray(values, dtype=object), max(len(verdicts), 1))
            for values, verdicts in zip(rows[name], rows["check_verdict"], strict=True)
        ]
        for name in PER_STEP
    }
    whole = rows.drop(columns="verdict").rename(
        columns={"check_verdict": "verdict", "check_error": "error", "check_eps": "at_eps"}
    )
    whole = whole.assign(row=range(len(rows)), **split)[rows["check_verdict"].map(len) > 0]
    return whole.explode([*PER_CHECK, "verdict", "error", "at_eps", *PER_STEP], ignore_index=True)


def long_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell, check and eps, and one line per cell that could not be checked.

    Columns that are not the study's own, such as swept parameters, are last. The column ``parameters`` is omitted,
    since it would be repeated on every line: ``rows.parquet`` has it under the same ``key``.
    """
    whole = ["experiment", *IDENTITY, "dim", "status", "reason"]
    added = [str(name) for name in rows if name not in GradientCheck.columns.by_name]
    last = list(dict.fromkeys(["key", *added, *(name for name in ("study",) if name in rows)]))
    names = [*whole, *PER_CHECK, "eps", *PER_STEP, "verdict", *last]
    lines = checks(rows).explode(["eps", *PER_STEP], ignore_index=True)
    unchecked = rows.loc[rows["check_verdict"].map(len) == 0, [*whole, "verdict", *last]]
    table = pd.concat([lines[names].infer_objects(), unchecked], ignore_index=True).reindex(columns=names)
    counts = ["horizon", "samples", "repeats", "dim", "seed", "sample", "direction"]
    return table.astype(dict.fromkeys(counts, float)).astype(dict.fromkeys(counts, "Int64"))


def component_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell and component of theta, with the columns :data:`PER_COMPONENT`."""
    names = ["experiment", *IDENTITY, "dim", *PER_COMPONENT, "key"]
    given = rows.loc[rows["component"].map(len) > 0, names]
    return given.explode([*PER_COMPONENT], ignore_index=True).infer_objects()


def by_point(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell and point: its worst verdict, and the largest error among its checks, with the eps.

    The error of a check is the smallest over all eps. ``row`` is the position of the cell in ``rows``, whose other columns
    follow. ``problem`` is a number, the same for cells with equal parameters of scene, contact law and integrator.
    """
    cells = rows.reset_index(drop=True).assign(problem=problem_numbers(rows, PROBLEM).to_numpy())
    table = checks(cells)[["row", "point", "verdict", "error", "at_eps"]].rename(columns={"at_eps": "eps"})
    table = table.astype({"error": float, "eps": float}).assign(rank=table["verdict"].map(VERDICTS.index))
    table = table.sort_values(["rank", "error"], ascending=[True, False], kind="stable")
    table = table.drop_duplicates(["row", "point"]).sort_index()
    return table.join(cells.drop(columns=table.columns, errors="ignore"), on="row")


def not_right(rows: pd.DataFrame) -> str:
    """Return which checks show a gradient that is wrong or open, by verdict, in words; empty without any.

    A jump or slope that only noise reaches does not count: the gradient itself can be right.
    """
    found = untrusted(checks(rows))
    found = found[(found["point"] != "noise") | ~found["verdict"].isin(BROKEN)]
    if found.empty:
        return ""
    return f"{_tally(found)} in {found['key'].nunique()} of {counted(len(rows), 'cell')}"


def untrusted(summary: pd.DataFrame) -> pd.DataFrame:
    """Return the lines, of checks or of points, whose gradient cannot be trusted."""
    pairs = zip(summary["point"], summary["verdict"], strict=True)
    return summary[np.array([not is_trusted(point, verdict) for point, verdict in pairs], dtype=bool)]


# ------------------------------------------------------------------------------------------------------- tables


def _tally(points: pd.DataFrame) -> str:
    """Return the verdicts of some points, each with the points that have it: ``wrong_factor (start, at)``."""
    at = points.groupby("verdict", sort=False)["point"]
    return ", ".join(f"{verdict} ({', '.join(dict.fromkeys(names))})" for verdict, names in at)


def _switches(names: Any) -> list[str]:
    """Return the contact switches of a cell's checks, each once; NaN, in an older row, has none."""
    return [] if isinstance(names, float) else list(dict.fromkeys(filter(None, names)))


def _lines(shown: Arranged, points: pd.DataFrame) -> tuple[pd.DataFrame, list[Column]]:
    """Return a line per problem, horizon, point and verdict with the worst error over backends and checks; the columns."""
    always = (*PROBLEM, "horizon")
    labels = [*always, *(name for name in label_columns(shown, PROBLEM, always=always) if name not in always)]
    line = ["problem", "point", "verdict"]
    frame = points.assign(
        backends=points.groupby(line, sort=False)["backend"].transform(lambda names: ", ".join(dict.fromkeys(names))),
        switch=[
            ", ".join(_switches(names)) for names in points["contact_switch"].where(points["point"] == "at", math.nan)
        ],
        place=points["point"].map(POINTS.index),
    )
    frame = frame.sort_values("error", ascending=False, kind="stable").drop_duplicates(line)
    frame = frame.sort_values(["problem", "place", "rank"], kind="stable")
    heads = [COMMON.get(name, setting(name)) for name in labels]
    return frame, [*heads, *map(text, ("point", "backends", "verdict")), ERROR, EPS, text("switch")]


def _verdicts(points: pd.DataFrame) -> tuple[pd.DataFrame, list[Column]]:
    """Return a line per verdict: its meaning, the number of points, the largest error and the scenes; and the columns."""
    lines = [
        {
            "verdict": verdict,
            "meaning": RULES[verdict].meaning,
            "trusted": _trusted(verdict, part),
            "points": len(part),
            "error": part["error"].max(),
            "scenes": ", ".join(dict.fromkeys(part["scene"])),
        }
        for verdict in VERDICTS
        if len(part := points[points["verdict"] == verdict])
    ]
    columns = [
        *map(text, ("verdict", "meaning", "trusted")),
        setting("points"),
        Column("error", label="largest error"),
        text("scenes"),
    ]
    return pd.DataFrame(lines, columns=[column.name for column in columns]), columns


def _trusted(verdict: str, points: pd.DataFrame) -> str:
    if len(untrusted(points)):
        return "no"
    return "yes" if verdict in TRUSTED else "beside the switch"


# ------------------------------------------------------------------------------------------------------- charts


def _grid(points: pd.DataFrame) -> Chart:
    """Return the main chart: the worst verdict of each problem at each horizon and point, over backends and checks."""
    letters = {verdict: letter for letter, (verdicts, _) in KINDS.items() for verdict in verdicts}
    names = {name: place for place, name in enumerate(dict.fromkeys(points["name"]))}
    frame = points.assign(
        letter=points["verdict"].map(letters),
        place=points["point"].map(POINTS.index),
        order=points["name"].map(names),
        point=points["point"].map(PLACES),
        steps=[counted(int(horizon), "step") if horizon > 0 else "no steps" for horizon in points["horizon"]],
    ).sort_values(["rank", "error"], ascending=[True, False], kind="stable")
    frame = frame.drop_duplicates(["name", "horizon", "point"]).sort_values(
        ["horizon", "place", "order"], kind="stable"
    )
    if frame.groupby("name")["steps"].nunique().max() == 1:  # a ladder, from the first problem to the last
        frame = frame.assign(name=frame["name"] + ", " + frame["steps"], steps="").sort_values(
            ["order", "place"], kind="stable"
        )
    return Chart(
        "gradient_check",
        frame,
        [text("point", label="")],
        [text("name", label="")],
        "grid",
        panel="steps",
        level="letter",
        cell="letter",
        styles={letter: style for letter, (_, style) in KINDS.items()},
        failed_name="no switch of contact, or no fault under noise, was found",
        subtitle=f"the worst verdict over all checks on the backends that run: {listed(short_names(points['backend']).values())}",
    )
