"""The page of the three errors: each against the swept numbers, and which gradients pass one test and fail another."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from bench.grid import Experiment
from bench.report.views import number
from bench.report.web.content import (
    STATUS,
    Axis,
    Chart,
    Column,
    Content,
    counted,
    identity_columns,
    looks,
    nothing_ran,
    titled,
)

ERRORS = {
    "model_error_rel": "model error, relative",
    "program_error_rel": "program error, relative",
    "bias_rel": "estimator error, relative",
    "forward_error_rel": "forward error, relative",
}
SWEPT = ("dt", "stiffness", "smoothing", "horizon", "sigma")
AGREES, WRONG = 1e-3, 0.1
"""Program errors up to which a gradient passes for its program's, and model errors from which it is not the physics'."""


def content(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> Content:
    """The gradients that match their program and not the physics, and every error."""
    labels = titled(rows, ["contact", "integrator"])
    made = rows.assign(
        series=labels, problem=rows["scene"], line=titled(rows, ["contact", "integrator", "backend", "estimator"])
    )
    swept = [name for name in SWEPT if rows[name].nunique() > 1]
    charts = [
        Chart(
            "The errors against each other",
            "High and to the left is the trap: right for the program, wrong for the physics.",
            [Axis(name, text) for name, text in ERRORS.items() if name != "model_error_rel"],
            [Axis("model_error_rel", ERRORS["model_error_rel"], above_one="larger than the gradient")],
            facet="problem",
        )
    ]
    if swept:
        along = Chart(
            "Errors along what was swept",
            "A model error that stays as the step shrinks is the contact model's, not the step's.",
            [Axis(name, name) for name in swept],
            [Axis(name, text, above_one="larger than the gradient") for name, text in ERRORS.items()],
            facet="problem",
        )
        charts.insert(0, along)
    return Content(
        finding=nothing_ran(rows) or finding(rows),
        rows=made,
        columns=[*identity_columns(rows), *(Column(name, text) for name, text in ERRORS.items()), *STATUS],
        charts=charts,
        answers=answers(rows),
        answers_title="Right for the program, wrong for the physics",
        looks=looks(list(labels)),
    )


def trapped(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows whose gradient is that of the program and not that of the physics, the worst first."""
    found = rows[(rows["program_error_rel"] <= AGREES) & (rows["model_error_rel"] >= WRONG)]
    return found.sort_values("model_error_rel", ascending=False)


def finding(rows: pd.DataFrame) -> str:
    """How many gradients match differences of their program and miss the physics, and the worst of them."""
    known = rows[rows["model_error_rel"].notna() & (rows["program_error_rel"] <= AGREES)]
    wrong = trapped(rows)
    text = f"{len(wrong)} of {counted(len(known), 'gradient')} that match differences of their program miss the physics' by over {WRONG:.0%}"
    if wrong.empty:
        return text + "."
    worst = wrong.iloc[0]
    name = ", ".join(filter(lambda part: part != "none", (worst["scene"], worst["contact"], worst["integrator"])))
    return f"{text}; the worst: {name}, off by {number(worst['model_error_rel'])} times it."


def answers(rows: pd.DataFrame) -> pd.DataFrame:
    """The problems with such gradients: the range of each error."""
    wrong = trapped(rows)
    found = []
    for problem, part in wrong.groupby(titled(wrong, ["scene", "contact", "integrator"]), sort=False):
        errors = {
            text: f"{number(part[name].min())} to {number(part[name].max())}"
            for name, text in ERRORS.items()
            if part[name].notna().any()
        }
        found.append({"problem": problem, "cells": len(part), **errors})
    return pd.DataFrame(found).fillna("-")
