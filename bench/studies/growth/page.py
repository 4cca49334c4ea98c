"""Builds the page of growth with the horizon: gradient norms, variances of both orders, and gains by lag."""

from __future__ import annotations

import numpy as np
import pandas as pd

from bench.experiment.experiment import Experiment
from bench.report.style import PALETTE
from bench.report.text import axis_value, number
from bench.report.views import Arranged, arrange
from bench.report.web.content import (
    STATUS,
    Chart,
    Content,
    PlotAxis,
    TableColumn,
    identity_columns,
    look,
    looks,
    no_result_sentence,
)
from bench.studies.growth.report import headline, problem_of

HORIZON = [PlotAxis("time_horizon", "horizon [s]"), PlotAxis("horizon", "horizon [steps]")]
RESULTS = [
    TableColumn("growth", "growth", "text"),
    TableColumn("gradient_median", "|gradient|, median"),
    TableColumn("stretch_rate", "stretch / step"),
    TableColumn("spectral_rate", "spectral / step"),
    TableColumn("first_order_variance", "variance, first order"),
    TableColumn("zeroth_order_variance", "variance, zeroth order"),
]
ORDERS = {"first_order": "first order", "zeroth_order": "zeroth order"}
CROSSING = "zeroth order has less variance"
"""Column of the answers: the horizon from which the zeroth order has the lower variance."""


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the content of the page: the finding, charts of norms, variances and gains, and the table."""
    shown = arrange(experiment, rows)
    problem = problem_of(shown)
    table = shown.rows.assign(series=problem, problem=problem)
    norms = Chart(
        "Norm of one sample's gradient against the horizon",
        "Median over noise samples; bars from 5% to 95% of them.",
        HORIZON,
        [
            PlotAxis("gradient_median", "norm of one sample's gradient", True, "gradient_low", "gradient_high"),
            *(
                PlotAxis(
                    f"{name}_rate", f"growth per step: log of the {quantity}", False, f"{name}_low", f"{name}_high"
                )
                for name, quantity in (("spectral", "spectral radius"), ("stretch", "largest singular value"))
            ),
        ],
        line="problem",
    )
    variances = Chart(
        "Variance per sample of both orders",
        "Beyond the crossing of the lines the zeroth order has the lower variance.",
        HORIZON,
        [PlotAxis("variance", "variance per sample", True, "low", "high")],
        table="variances",
        facet="problem",
        line="series",
    )
    gains = Chart(
        "How far back does a gradient reach?",
        "Largest singular value of the Jacobian product over that many steps: median and 5% to 95% of the rollouts.",
        [PlotAxis("lag", "lag [steps]")],
        [PlotAxis("gain", "gain", True, "gain_low", "gain_high")],
        table="gains",
        line="line",
    )
    return Content(
        finding=no_result_sentence(rows) or finding(answers(shown)),
        rows=table,
        columns=[*identity_columns(table, [axis.column for axis in shown.axes]), *RESULTS, *STATUS],
        charts=[norms, variances, gains],
        answers=answers(shown),
        answers_title="Growth of the gradient",
        tables={"variances": variances_of(table), "gains": gains_of(table)},
        looks={
            **looks(list(problem)),
            "first order": look(PALETTE[2], "diamond"),
            "zeroth order": look(PALETTE[5], "cross", "dash"),
        },
    )


def variances_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the data of the chart of variances, one line per row and order."""
    rows = rows.assign(row=range(len(rows))).sort_values("horizon", kind="stable")
    parts = [
        pd.DataFrame({
            "row": rows["row"], "problem": rows["problem"], "series": name, "variance": rows[f"{order}_variance"],
            "low": rows[f"{order}_variance_low"], "high": rows[f"{order}_variance_high"],
        })
        for order, name in ORDERS.items()
    ]  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def gains_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the data of the chart of gains, one line per problem and lag, at each problem's longest horizon."""
    longest = (
        rows.assign(row=range(len(rows))).sort_values("horizon", kind="stable").drop_duplicates("problem", keep="last")
    )
    names = ["row", "series", "line", "lag", "gain", "gain_low", "gain_high"]
    lines = [
        (row["row"], row["series"], row["problem"], *values)
        for row in longest.sort_values("row").to_dict("records")
        for values in zip(row["lags"], row["gain"], row["gain_low"], row["gain_high"], strict=True)
    ]
    return pd.DataFrame(lines, columns=names)


def finding(table: pd.DataFrame) -> str:
    """Format on which problems gradients explode or vanish, and from which horizon the zeroth order has less variance."""
    better = table[table[CROSSING] != "nowhere"]
    text = headline(dict(zip(table["problem"], table["growth"], strict=True)))
    crossings = ", ".join(
        f"{problem} {horizon}" for problem, horizon in zip(better["problem"], better[CROSSING], strict=True)
    )
    return f"{text}. The zeroth order has the lower variance " + (f"on {crossings}." if crossings else "on no problem.")


def answers(shown: Arranged) -> pd.DataFrame:
    """Return a line per problem: growth at the longest horizon, norms at both ends, and where the variances cross."""
    lines = []
    good = shown.rows[np.isfinite(shown.rows["gradient_median"])]
    for problem, part in good.groupby(problem_of(shown, good), sort=False):
        part = part.sort_values("time_horizon")
        first, last = part.iloc[0], part.iloc[-1]
        is_lower = (part["zeroth_order_variance"] < part["first_order_variance"]).to_numpy()
        higher = np.flatnonzero(~is_lower)
        start = int(higher[-1]) + 1 if len(higher) else 0
        crossing = f"from {axis_value(part['horizon'].iloc[start])} steps" if start < len(part) else "nowhere"
        ends = [f"{number(row['gradient_median'])} at {axis_value(row['horizon'])} steps" for row in (first, last)]
        lines.append([str(problem), last["growth"], number(last["spectral_rate"] / last["dt"]), *ends, crossing])
    return pd.DataFrame(lines, columns=["problem", "growth", "per second", "norm, shortest", "norm, longest", CROSSING])
