"""The page of the three errors: each against the swept numbers, and which gradients pass one test and fail another."""

from __future__ import annotations

import pandas as pd

from bench.experiment.experiment import Experiment
from bench.report.text import counted, number
from bench.report.views import Arranged, arranged
from bench.report.web.content import (
    STATUS,
    Chart,
    Content,
    PlotAxis,
    TableColumn,
    identity_columns,
    logarithmic,
    looks,
    nothing_ran,
    numeric_axis,
    problems,
)

ERRORS = {
    "model_error_rel": "model error, relative",
    "program_error_rel": "program error, relative",
    "bias_rel": "estimator error, relative",
    "forward_error_rel": "forward error, relative",
}
PROBLEM = ("scene", "contact", "integrator")
AGREES, WRONG = 1e-3, 0.1
"""Largest program error of a gradient that passes for its program's, and smallest model error of one that is wrong."""


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the gradients that match their program but not the physics, and every error."""
    shown = arranged(experiment, rows)
    laws = problems(shown, ["contact", "integrator"], shown.axes, ("contact", "integrator"))
    table = shown.rows.assign(series=laws, problem=problems(shown, ["scene"], shown.axes))
    swept = [numeric_axis(axis, axis.column, logarithmic(table[axis.column])) for axis in shown.swept()]
    charts = [
        Chart(
            "The errors against each other",
            "High and to the left is the trap: right for the program, wrong for the physics.",
            [PlotAxis(name, text) for name, text in ERRORS.items() if name != "model_error_rel"],
            [PlotAxis("model_error_rel", ERRORS["model_error_rel"], above_one="larger than the gradient")],
            facet="problem",
        )
    ]
    if swept:
        along = Chart(
            "Errors along what was swept",
            "A model error that stays as the step shrinks is the contact model's, not the step's.",
            swept,
            [PlotAxis(name, text, above_one="larger than the gradient") for name, text in ERRORS.items()],
            facet="problem",
        )
        charts.insert(0, along)
    return Content(
        finding=nothing_ran(rows) or finding(rows),
        rows=table,
        columns=[
            *identity_columns(table, [axis.column for axis in shown.axes]),
            *(TableColumn(name, text) for name, text in ERRORS.items()),
            *STATUS,
        ],
        charts=charts,
        answers=answers(shown),
        answers_title="Right for the program, wrong for the physics",
        looks=looks(list(laws)),
    )


def trapped(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows whose gradient is that of the program but not that of the physics, worst first."""
    misses = rows[(rows["program_error_rel"] <= AGREES) & (rows["model_error_rel"] >= WRONG)]
    return misses.sort_values("model_error_rel", ascending=False)


def finding(rows: pd.DataFrame) -> str:
    """Write how many gradients match differences of their program but miss the physics, and the worst of them."""
    exact = rows[rows["model_error_rel"].notna() & (rows["program_error_rel"] <= AGREES)]
    wrong = trapped(rows)
    one = len(exact) == 1
    match, their, miss = ("matches", "its", "misses") if one else ("match", "their", "miss")
    text = f"{len(wrong)} of {counted(len(exact), 'gradient')} that {match} differences of {their} program {miss} the physics' by over {WRONG:.0%}"
    if wrong.empty:
        return text + "."
    worst = wrong.iloc[0]
    name = ", ".join(filter(lambda part: part != "none", (worst["scene"], worst["contact"], worst["integrator"])))
    return f"{text}; the worst: {name}, off by {number(worst['model_error_rel'])} times it."


def answers(shown: Arranged) -> pd.DataFrame:
    """Return the problems with such gradients: the range of each error over everything that was swept."""
    wrong = trapped(shown.rows)
    lines = []
    for problem, part in wrong.groupby(problems(shown, PROBLEM, shown.axes, PROBLEM, wrong), sort=False):
        errors = {
            text: f"{number(part[name].min())} to {number(part[name].max())}"
            for name, text in ERRORS.items()
            if part[name].notna().any()
        }
        lines.append({"problem": problem, "cells": len(part), **errors})
    return pd.DataFrame(lines).fillna("-")
