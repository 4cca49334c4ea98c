"""What the study of growth shows: which curve the norms of gradients follow, and where the zeroth order varies less."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import table
from bench.experiment.columns import COMMON, Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Table, Views
from bench.report.colours import estimator_colour
from bench.report.problems import axes_of, label_columns, problem_names
from bench.report.shown import stacked
from bench.report.style import PALETTE
from bench.report.text import axis_value, number
from bench.report.views import Arranged, arrange, attempted
from bench.report.writer import reasons
from bench.studies.growth.columns import COLUMNS, ORDERS
from bench.studies.growth.fits import Curve, fit

PROBLEM = ("scene", "contact", "integrator", "backend")
"""Parts of the grid that identify a problem. It is drawn along the horizon and the axes that step with it."""
ROUNDING = float(np.finfo(np.float64).eps)
"""Share of the largest singular value up to which another singular value is a rounding error."""
FINE = 30
"""Points of a drawn curve."""
FIRST = "first order at every horizon"
NORM, CURVES = "norm of one gradient", {"exploding": "exponential", "vanishing": "decay", "polynomial": "power law"}
"""Names of the series of the main chart, by verdict."""
STYLES = {
    NORM: Style("#000000", meaning="norm of one sample's gradient, with 5% to 95%"),
    "exponential": Style(PALETTE[2], "", width=2.2, meaning="the exponential it follows"),
    "power law": Style(PALETTE[0], "", "--", width=2.2, meaning="the power law it follows"),
    "decay": Style(PALETTE[3], "", ":", width=2.2, meaning="the decay it follows"),
}
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
    "exploding if the spectral radius certainly grows, vanishing if the stretch certainly falls. singular values: largest "
    "and smallest of that product, median. gain: largest singular value of dx_N/du_0 (dx_N/dx_1 without controls), median. "
    "variance: per sample, median and 5% to 95% of the repeats."
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return a table with a line per problem and one with a line per cell, and the charts."""
    shown = arrange(experiment, rows)
    cells = Table(
        "growth",
        *_cells(shown),
        data=table(experiment, rows),
        title="growth of gradients with the horizon",
        notes=[NOTE],
    )
    named = shown.rows.assign(problem=problem_of(shown))
    good = attempted(named)
    good = good[np.isfinite(good["gradient_median"]) & (good["gradient_median"] > 0)]
    if good.empty:
        return Views([cells], remarks=reasons(rows))
    lines = verdicts(good)
    answers = Table(
        "growth_verdicts",
        lines,
        VERDICT,
        data=lines.drop(columns="fit"),
        title="Growth of the gradient",
        notes=[VERDICT_NOTE],
        terminal=True,
        page=True,
    )
    return Views([answers, cells], [_norms(good, lines), *_further(good)], named, remarks=reasons(rows))


def problem_of(shown: Arranged, rows: pd.DataFrame | None = None) -> pd.Series:
    """Return, per row, the name of its problem, the same at every horizon."""
    return problem_names(shown, PROBLEM, axes_of(shown, "horizon"), rows=rows)


# ------------------------------------------------------------------------------------------------------ verdicts


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
        lines.append({
            "problem": problem, "verdict": fitted.verdict, "odds": fitted.odds, **_slope("order", fitted.power),
            **_slope("rate", fitted.exponential), **_variances(part), "fit": fitted,
        })  # fmt: skip
    return pd.DataFrame(lines)


def _slope(name: str, curve: Curve) -> dict[str, float]:
    return {name: curve.slope, f"{name}_low": curve.low, f"{name}_high": curve.high}


def _variances(part: pd.DataFrame) -> dict[str, Any]:
    """Return which order has the lower variance, and from which horizon the zeroth order has it; NaN if from none."""
    times = part["time_horizon"].to_numpy(float)
    zeroth = (part["zeroth_order_variance_high"] < part["first_order_variance_low"]).to_numpy()
    first = (part["first_order_variance_high"] < part["zeroth_order_variance_low"]).to_numpy()
    start = len(zeroth) - int(np.argmin(zeroth[::-1])) if not zeroth.all() else 0
    if start < len(times):
        return {"lower": f"zeroth order from {axis_value(times[start])} s", "zeroth_from": times[start]}
    return {"lower": FIRST if first.all() else "open at the longest horizon", "zeroth_from": math.nan}


# ------------------------------------------------------------------------------------------------------- table


def _cells(shown: Arranged) -> tuple[pd.DataFrame, list[Column]]:
    """Return a line per cell, ordered by scene and horizon, with rates per second, and the columns for readers."""
    labels = [name for name in label_columns(shown, PROBLEM, axes_of(shown, "horizon")) if name != "horizon"]
    rows = shown.rows.assign(place=pd.factorize(shown.rows["scene"])[0]).sort_values(
        ["place", "time_horizon"], kind="stable"
    )
    rates = [f"{kind}_{end}" for kind in ("stretch", "spectral") for end in ("rate", "low", "high")]
    frame = rows.assign(
        **{name: rows[name] / rows["dt"] for name in rates},
        singular_values=[_ends(values) for values in rows["singular_values"]],
        gain=[number(values[-1]) if len(values) else "-" for values in rows["gain"]],
    )
    own = COLUMNS.by_name
    return frame, [
        *(COMMON.get(name, Column(name, format="setting")) for name in labels), COMMON["horizon"], own["time_horizon"],
        own["gradient_median"], *(replace(own[f"{kind}_rate"], unit="1/s") for kind in ("stretch", "spectral")),
        own["growth"], own["singular_values"], own["gain"], *(replace(own[f"{order}_variance"], low="", high="") for order in ORDERS),
        COMMON["status"],
    ]  # fmt: skip


def _ends(values: Sequence[float]) -> str:
    """Format the largest and smallest singular value; the smallest as ``< u`` if it is below the rounding error u."""
    if not len(values):
        return "-"
    floor = ROUNDING * values[0]
    return f"{number(values[0])} to " + (number(values[-1]) if values[-1] > floor else f"< {number(floor)}")


# ------------------------------------------------------------------------------------------------------- charts


def _norms(good: pd.DataFrame, lines: pd.DataFrame) -> Chart:
    """Return the main chart: norms against the horizon, and the curve that they follow, a panel per problem."""
    parts = [good.assign(series=NORM, row=good.index)]
    for line in lines.to_dict("records"):
        part = good[good["problem"] == line["problem"]]
        if line["fit"].curve is not None:
            times = np.geomspace(part["time_horizon"].min(), part["time_horizon"].max(), FINE)
            parts.append(pd.DataFrame({
                "problem": line["problem"], "series": CURVES[line["verdict"]], "time_horizon": times,
                "gradient_median": line["fit"].at(times), "row": part.index[-1],
            }))  # fmt: skip
    horizon, norm = (COLUMNS.by_name[name] for name in ("time_horizon", "gradient_median"))
    return Chart(
        "growth", pd.concat(parts, ignore_index=True), [replace(horizon, log=True)], [replace(norm, log=True)],
        series="series", panel="problem", styles=STYLES, across=5, height=1.9, band=True,
        panel_notes=dict(zip(lines["problem"], lines["verdict"], strict=True)),
        text="Median over noise samples, and 5% to 95% of them. On these axes a power law is straight and an exponential "
        "bends upwards. Where it is open which one the norms follow, no curve is drawn.",
    )  # fmt: skip


def looks() -> dict[str, Style]:
    """Return the look of the variance of each order."""
    return {
        "first_order": Style(estimator_colour("fobg"), "D"),
        "zeroth_order": Style(estimator_colour("reinforce"), "P", (0, (4, 1.5))),
    }


def _further(good: pd.DataFrame) -> list[Chart]:
    """Return the charts of the page: rates of the Jacobian product, variances of both orders, and gains by lag."""
    own = COLUMNS.by_name
    horizon = [own["time_horizon"], own["horizon"]]
    cells = good.assign(row=good.index)
    names = {order: f"{name} term" for order, name in ORDERS.items()}
    styles = {name: looks()[order] for order, name in names.items()}
    variances = stacked(cells, {name: f"{order}_variance" for order, name in names.items()}, "variance")
    longest = cells.sort_values("horizon", kind="stable").drop_duplicates("problem", keep="last").sort_index()
    gains = longest[["problem", "row", "lags", "gain", "gain_low", "gain_high"]].explode(
        ["lags", "gain", "gain_low", "gain_high"], ignore_index=True
    )
    gains = gains.astype({name: float for name in ("lags", "gain", "gain_low", "gain_high")})
    variance = replace(own["first_order_variance"], name="variance", label="variance per sample", low="variance_low",
                       high="variance_high", log=True)  # fmt: skip
    return [
        Chart(
            "growth_variances", variances,
            horizon, [variance], series="series", panel="problem", styles=styles, printed=False,
            text="Median over repeats, and 5% to 95% of them.",
        ),
        Chart(
            "growth_rates", cells, horizon,
            [own["gradient_median"], replace(own["spectral_rate"], unit="per step"), replace(own["stretch_rate"], unit="per step")],
            series="problem", printed=False, text="Means over noise samples with 95% intervals, per step.",
        ),
        Chart(
            "growth_gains", gains,
            [replace(own["lags"], kind="number", label="lag")],
            [replace(own["gain"], kind="number", low="gain_low", high="gain_high", log=True)],
            series="problem", printed=False,
            text="Largest singular value of the Jacobian product over that many steps: median and 5% to 95% of the rollouts.",
        ),
    ]  # fmt: skip
