"""What the study of growth shows: which curve the norms of gradients follow, and where the zeroth order varies less."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from bench.experiment.columns import COMMON, Column, interval, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Table, Views
from bench.report.shown import Shown

from . import ORDERS, RATES

STRONG = 20.0
"""Ratio of likelihoods from which one curve beats the other. By it, at most 5% of noisy power laws count as exploding."""
ROUNDING = 1e-6
"""Smallest error of a norm's logarithm: norms that a curve describes exactly differ from it by rounding."""
FEWEST = 5
"""Fewest horizons of a verdict: with four, 8% of noisy power laws count as exploding."""
PROBLEM = ("scene", "contact", "integrator", "backend")
"""Parts of the grid that identify a problem. It is drawn along the horizon and the axes that step with it."""
VERDICT = (
    text("problem"),
    text("verdict", "what the norms do along the horizon"),
    interval("order", "order of the best power law"),
    interval("rate", "rate of the best exponential", "1/s"),
    Column("odds", "likelihood of the exponential relative to the power law", label="exponential to power law"),
    text("lower", "the order whose variance is lower beyond doubt", label="lower variance"),
    Column("zeroth_from", "horizon from which on that is the zeroth order", "s", label="from", format="setting"),
)
"""The columns of the table with a line per problem."""
VERDICT_NOTE = (
    "Median norms of one sample's gradient against the horizon, fitted by a power law and by an exponential. exploding: the "
    "exponential is at least 20 times as likely as the power law, and its rate is above 0. polynomial: the power law is as "
    "much more likely, or the more likely one where the Jacobian product does not grow, and its order is above 0. "
    "vanishing: the better curve falls by as much evidence. open: none of these. Intervals are of 95%. A variance is lower where the ranges over "
    "repeats from 5% to 95% do not overlap: first at every horizon, zeroth from a horizon on, else open."
)
NOTE = (
    "norm of one gradient: median and 5% to 95% of the noise samples. stretch, spectral: log of the largest singular value "
    "and of the spectral radius of the Jacobian product dx_N/dx_0, per second, mean and 95% interval. Jacobian product: "
    "exploding if the spectral radius certainly grows, vanishing if the stretch certainly falls. variance: per sample, median."
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return a table with a line per problem and one with a line per cell, and the charts."""
    shown = Shown(experiment, rows, along=["horizon"], method=(), problem=PROBLEM)
    per_second = {
        f"{name}_{end}": shown.rows[f"{name}_{end}"] / shown.rows["dt"] for name in RATES for end in ("rate", "low", "high")
    }  # fmt: skip
    columns = [
        COMMON["horizon"], shown.column("time_horizon"), shown.column("gradient_median"),
        *(shown.column(f"{name}_rate", unit="1/s") for name in RATES), shown.column("growth"),
        *(shown.column(f"{order}_variance", low="", high="") for order in ORDERS),
    ]  # fmt: skip
    cells = shown.cells(columns, "growth of gradients with the horizon", [NOTE], ("scene", "contact"),
                        shown.rows.assign(**per_second), terminal=False)  # fmt: skip
    good = shown.rows[np.isfinite(shown.rows["gradient_median"]) & (shown.rows["gradient_median"] > 0)]
    if good.empty:
        return Views([cells])
    lines = pd.DataFrame([verdict(part) for _, part in good.groupby("problem", sort=False)])
    answers = Table(
        "growth_verdicts", lines, VERDICT, "Growth of the gradient", [VERDICT_NOTE], terminal=True, page=True
    )
    chart = Chart(
        "growth", good, [shown.column("time_horizon", log=True)], [shown.column("gradient_median", log=True)], panel="problem",
        across=5, height=1.9, band=True, panel_notes=dict(zip(lines["problem"], lines["verdict"], strict=True)),
        text="Median over noise samples, and 5% to 95% of them. On these axes a power law is straight and an exponential bends upwards.",
    )  # fmt: skip
    named = shown.arranged.rows.assign(problem=shown.rows["problem"]).fillna({"problem": ""})
    return Views([answers, cells], [chart], named)


def verdict(rows: pd.DataFrame) -> dict[str, Any]:
    """Return the line of one problem: the curves through its norms, the verdict, and where variances cross."""
    rows = rows.sort_values("time_horizon", kind="stable")
    counts = rows["samples"] * rows["repeats"] * rows["finite_fraction"]
    spread = np.log(rows["gradient_three_quarters"] / rows["gradient_quarter"])
    # standard error of a normal median: 1.2533 sigma / sqrt(n), and sigma is the interquartile range / 1.349
    errors = (1.2533 / 1.349 * spread / np.sqrt(counts)).fillna(0.0).to_numpy(float)
    horizons, norms = (rows[name].to_numpy(float) for name in ("time_horizon", "gradient_median"))
    fitted = fit(horizons, norms, errors, bounded=rows["growth"].iloc[-1] in ("neutral", "vanishing"))
    zeroth = (rows["zeroth_order_variance_high"] < rows["first_order_variance_low"]).to_numpy()
    is_first = (rows["first_order_variance_high"] < rows["zeroth_order_variance_low"]).all()
    # the first of the longest horizons at all of which the zeroth order varies less
    start = horizons[np.logical_and.accumulate(zeroth[::-1])[::-1]].min(initial=math.inf)
    lower = "zeroth" if math.isfinite(start) else "first" if is_first else "open"
    return {"problem": rows["problem"].iloc[0], **fitted, "lower": lower,
            "zeroth_from": start if lower == "zeroth" else math.nan}  # fmt: skip


def fit(horizons: np.ndarray, norms: np.ndarray, errors: np.ndarray, bounded: bool = False) -> dict[str, Any]:
    """Fit a power law and an exponential to norms ``(n,)``; return the verdict on which they follow, ``odds`` and slopes.

    ``errors`` are the standard errors of the norms' logarithms. ``bounded`` states that the Jacobian product does not
    grow, which leaves the power law if the norms do not contradict it. The ratio of likelihoods of two least-squares fits
    with equally many parameters is (residual_1 / residual_2)^(n/2).
    """
    places, logarithms, errors = (np.log(horizons), horizons), np.log(norms), np.maximum(errors, ROUNDING)
    (*order, power), (*rate, exponential) = (_slope(at, logarithms, errors) for at in places)
    odds = (power / exponential) ** (len(norms) / 2) if len(norms) >= FEWEST else math.nan
    verdict = "open"
    if odds >= STRONG and rate[1] > 0:
        verdict = "exploding"
    elif (odds >= STRONG and rate[2] < 0) or (odds <= 1 / STRONG and order[2] < 0):
        verdict = "vanishing"
    elif order[1] > 0 and (odds <= 1 / STRONG or (odds <= 1 and bounded)):
        verdict = "polynomial"
    names = (f"{name}{end}" for name in ("order", "rate") for end in ("", "_low", "_high"))
    return {"verdict": verdict, "odds": odds, **dict(zip(names, (*order, *rate), strict=True))}


def _slope(places: np.ndarray, logarithms: np.ndarray, errors: np.ndarray) -> tuple[float, ...]:
    """Return the slope of a line with its 95% interval (Student's t), and the sum of squared residuals and errors."""
    count = len(places)
    if count < 3 or np.ptp(places) == 0:
        return (math.nan,) * 4
    away = places - places.mean()
    slope = float(away @ logarithms / (away @ away))
    start = float(logarithms.mean() - slope * places.mean())
    left = logarithms - start - slope * places
    residual = float(left @ left + errors @ errors)
    reach = float(stdtrit(count - 2, 0.975)) * math.sqrt(residual / (count - 2) / float(away @ away))
    return slope, slope - reach, slope + reach, residual
