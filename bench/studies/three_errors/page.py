"""Builds the page of the three errors: each error along the swept parameters, and misleading gradients."""

from __future__ import annotations

import pandas as pd

from bench.experiment.experiment import Experiment
from bench.report.problems import problem_names
from bench.report.text import counted, number
from bench.report.views import Arranged, arrange, is_logarithmic
from bench.report.web.content import (
    STATUS,
    Chart,
    Content,
    PlotAxis,
    TableColumn,
    identity_columns,
    looks,
    no_result_sentence,
    numeric_axis,
)

ERRORS = {
    "model_error_rel": "model error, relative",
    "program_error_rel": "program error, relative",
    "bias_rel": "estimator error, relative",
    "forward_error_rel": "forward error, relative",
}
PROBLEM = ("scene", "contact", "integrator")
AGREES, WRONG = 1e-3, 0.1
"""Largest program error of a gradient that is right for its program, and smallest model error of a wrong gradient."""


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the content of the page: the finding, charts of the errors, and the misleading gradients."""
    shown = arrange(experiment, rows)
    laws = problem_names(shown, ["contact", "integrator"], shown.axes, ("contact", "integrator"))
    table = shown.rows.assign(series=laws, problem=problem_names(shown, ["scene"], shown.axes))
    swept = [numeric_axis(axis, axis.column, is_logarithmic(table[axis.column])) for axis in shown.swept()]
    charts = [
        Chart(
            "The errors against each other",
            "Traps are at the upper left: right for the program, wrong for the physics.",
            [PlotAxis(name, text) for name, text in ERRORS.items() if name != "model_error_rel"],
            [PlotAxis("model_error_rel", ERRORS["model_error_rel"], above_one="larger than the gradient")],
            facet="problem",
        )
    ]
    if swept:
        along = Chart(
            "Errors along the swept parameters",
            "A model error that does not shrink with the step is due to the contact model.",
            swept,
            [PlotAxis(name, text, above_one="larger than the gradient") for name, text in ERRORS.items()],
            facet="problem",
        )
        charts.insert(0, along)
    return Content(
        finding=no_result_sentence(rows) or finding(rows),
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


def misleading(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with a misleading gradient, right for the program but wrong for the physics, the worst first."""
    misses = rows[(rows["program_error_rel"] <= AGREES) & (rows["model_error_rel"] >= WRONG)]
    return misses.sort_values("model_error_rel", ascending=False)


def finding(rows: pd.DataFrame) -> str:
    """Format how many gradients are right for their program but wrong for the physics, and the worst one."""
    exact = rows[rows["model_error_rel"].notna() & (rows["program_error_rel"] <= AGREES)]
    wrong = misleading(rows)
    text = (
        f"Of {counted(len(exact), 'gradient')} confirmed by differences of the program's cost, {len(wrong)} "
        f"{'is' if len(wrong) == 1 else 'are'} off by over {WRONG:.0%} from the gradient of the physics"
    )
    if wrong.empty:
        return text + "."
    worst = wrong.iloc[0]
    name = ", ".join(part for part in (worst["scene"], worst["contact"], worst["integrator"]) if part != "none")
    return f"{text}. Worst: {name}, with a relative error of {number(worst['model_error_rel'])}."


def answers(shown: Arranged) -> pd.DataFrame:
    """Return the problems with misleading gradients, and the range of each error over the swept parameters."""
    wrong = misleading(shown.rows)
    lines = []
    for problem, part in wrong.groupby(problem_names(shown, PROBLEM, shown.axes, PROBLEM, wrong), sort=False):
        errors = {
            text: f"{number(part[name].min())} to {number(part[name].max())}"
            for name, text in ERRORS.items()
            if part[name].notna().any()
        }
        lines.append({"problem": problem, "cells": len(part), **errors})
    return pd.DataFrame(lines).fillna("-")
