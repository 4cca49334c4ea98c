"""What the study of growth shows: which curve the norms of gradients follow, and where the zeroth order varies less."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from bench.experiment.columns import COMMON, Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Table, Views
from bench.report.colours import estimator_colour
from bench.report.shown import Shown, stacked
from bench.report.text import axis_value
from bench.report.writer import reasons
from bench.studies.growth.columns import ORDERS
from bench.studies.growth.fits import fit

PROBLEM = ("scene", "contact", "integrator", "backend")
"""Parts of the grid that identify a problem. It is drawn along the horizon and the axes that step with it."""
FIRST = "first order at every horizon"
VERDICT = (
    text("problem"),
    text("verdict", "what the norms do along the horizon"),
    Column("order", "order of the best power law", low="order_low", high="order_high"),
    Column("rate", "rate of the best exponential", "1/s", low="rate_low", high="rate_high"),
    Column("odds", "likelihood of the exponential relative to the power law", label="exponential to power law"),
    text("lower", "the order whose variance is lower beyond doubt", label="lower variance"),
)
"""The columns of the table with a line per problem."""
VERDICT_NOTE = (
    "Median norms of one sample's gradient against the horizon, fitted by a power law and by an exponential. exploding: the "
    "exponential is at least 20 times as likely as the power law, and its rate is above 0. polynomial: the power law is as "
    "much more likely, or the more likely one where the Jacobian product does not grow, and its order is above 0. "
    "vanishing: the better curve falls by as much evidence. open: none of these. Intervals are of 95%. A variance is lower where the ranges over "
    "repeats from 5% to 95% do not overlap."
)
NOTE = (
    "norm of one gradient: median and 5% to 95% of the noise samples. stretch, spectral: log of the largest singular value "
    "and of the spectral radius of the Jacobian product dx_N/dx_0, per second, mean and 95% interval. Jacobian product: "
    "exploding if the spectral radius certainly grows, vanishing if the stretch certainly falls. variance: per sample, median."
)
RATES = ("stretch", "spectral")


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return a table with a line per problem and one with a line per cell, and the charts."""
    shown = Shown(experiment, rows, along=["horizon"], method=(), problem=PROBLEM)
    per_second = {
        f"{rate}_{end}": shown.rows[f"{rate}_{end}"] / shown.rows["dt"]
        for rate in RATES
        for end in ("rate", "low", "high")
    }
    columns = [
        COMMON["horizon"], shown.column("time_horizon"), shown.column("gradient_median"),
        *(shown.column(f"{rate}_rate", unit="1/s") for rate in RATES), shown.column("growth"),
        *(shown.column(f"{order}_variance", low="", high="") for order in ORDERS),
    ]  # fmt: skip
    cells = shown.cells(columns, "growth of gradients with the horizon", [NOTE], ("scene", "contact"),
                        shown.rows.assign(**per_second), terminal=False)  # fmt: skip
    good = shown.rows[np.isfinite(shown.rows["gradient_median"]) & (shown.rows["gradient_median"] > 0)]
    if good.empty:
        return Views([cells], remarks=reasons(rows))
    lines = verdicts(good)
    answers = Table(
        "growth_verdicts", lines, VERDICT, "Growth of the gradient", [VERDICT_NOTE], terminal=True, page=True
    )
    named = shown.arranged.rows.assign(problem=shown.rows["problem"]).fillna({"problem": ""})
    return Views([answers, cells], charts(shown, good, lines), named, remarks=reasons(rows))


def verdicts(good: pd.DataFrame) -> pd.DataFrame:
    """Return a line per problem: the curves through the norms of its rows, the verdict, and where variances cross."""
    lines = []
    for problem, part in good.groupby("problem", sort=False):
        part = part.sort_values("time_horizon", kind="stable")
        counts = part["samples"] * part["repeats"] * part["finite_fraction"]
        spread = np.log(part["gradient_three_quarters"] / part["gradient_quarter"])
        # standard error of a normal median: 1.2533 sigma / sqrt(n), and sigma is the interquartile range / 1.349
        errors = (1.2533 / 1.349 * spread / np.sqrt(counts)).fillna(0.0).to_numpy(float)
        horizons, norms = (part[name].to_numpy(float) for name in ("time_horizon", "gradient_median"))
        fitted = fit(horizons, norms, errors, bounded=part["growth"].iloc[-1] in ("neutral", "vanishing"))
        slopes = {"order": fitted.power, "rate": fitted.exponential}
        ends = {f"{name}{end}": value for name, slope in slopes.items()
                for end, value in (("", slope.value), ("_low", slope.low), ("_high", slope.high))}  # fmt: skip
        zeroth = (part["zeroth_order_variance_high"] < part["first_order_variance_low"]).to_numpy()
        start = 0 if zeroth.all() else len(zeroth) - int(np.argmin(zeroth[::-1]))
        lower = (
            FIRST
            if (part["first_order_variance_high"] < part["zeroth_order_variance_low"]).all()
            else "open at the longest horizon"
        )
        if is_crossed := start < len(horizons):
            lower = f"zeroth order from {axis_value(horizons[start])} s"
        lines.append({"problem": problem, "verdict": fitted.verdict, "odds": fitted.odds, **ends, "lower": lower,
                      "zeroth_from": horizons[start] if is_crossed else math.nan})  # fmt: skip
    return pd.DataFrame(lines)


def looks() -> dict[str, Style]:
    """Return the look of the variance of each order."""
    return {
        "first_order": Style(estimator_colour("fobg"), "D"),
        "zeroth_order": Style(estimator_colour("reinforce"), "P", (0, (4, 1.5))),
    }


def charts(shown: Shown, good: pd.DataFrame, lines: pd.DataFrame) -> list[Chart]:
    """Return the norms along the horizon, and for the page variances of both orders, rates, and gains by lag."""
    horizon = [shown.column("time_horizon", log=True), COMMON["horizon"]]
    names = {order: f"{name} term" for order, name in ORDERS.items()}
    variances = stacked(good, {name: f"{order}_variance" for order, name in names.items()}, "variance")
    variance = Column("variance", label="variance per sample", low="variance_low", high="variance_high", log=True)
    values = ["lags", "gain", "gain_low", "gain_high"]
    longest = good.sort_values("horizon", kind="stable").drop_duplicates("problem", keep="last").sort_index()
    gains = longest[["problem", "row", *values]].explode(values, ignore_index=True).astype(dict.fromkeys(values, float))
    gain = shown.column("gain", kind="number", low="gain_low", high="gain_high", log=True)
    rates = [shown.column(f"{rate}_rate", unit="per step") for rate in reversed(RATES)]
    norm = shown.column("gradient_median", log=True)
    return [
        Chart("growth", good, horizon[:1], [norm], panel="problem", across=5, height=1.9, band=True,
              panel_notes=dict(zip(lines["problem"], lines["verdict"], strict=True)),
              text="Median over noise samples, and 5% to 95% of them. On these axes a power law is straight and an exponential "
              "bends upwards."),
        Chart("growth_variances", variances, horizon, [variance], series="series", panel="problem", printed=False,
              styles={name: looks()[order] for order, name in names.items()}, text="Median over repeats, and 5% to 95% of them."),
        Chart("growth_rates", good, horizon, [norm, *rates], series="problem", printed=False,
              text="Means over noise samples with 95% intervals, per step."),
        Chart("growth_gains", gains, [shown.column("lags", kind="number", label="lag")], [gain], series="problem", printed=False,
              text="Largest singular value of the Jacobian product over that many steps: median and 5% to 95% of the rollouts."),
    ]  # fmt: skip
