"""What the study of engines shows: which engine's gradient can be used on which scene, its errors and its costs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.special import chdtri

from bench.experiment.columns import text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Views
from bench.report.generic import engine_table
from bench.report.problems import problem_names
from bench.report.style import PALETTE
from bench.report.text import duration, number
from bench.report.views import arrange
from bench.report.writer import reasons

ACCURATE = 0.02
"""Relative program error up to which a gradient counts as the derivative of its program. Differences of float32 costs
have two digits."""
SAME = 0.1
"""Relative model error up to which a gradient counts as the gradient of the model."""
NAMED = 2
"""Most engines without a usable gradient that the title names."""
USELESS = 1.0
"""Relative RMSE from which on an estimate is no better than the zero estimate."""
SHOWN = (
    "program_error_rel", "model_error_rel", "rmse_rel", "zeroth_rmse_rel", "nan_share", "value_s", "gradient_s", "first_s",
    "pipe_share", "memory_mb",
)  # fmt: skip
DETAILS = (
    "difference_step", "model", "reference_norm", "reference_se", "reference_method", "bias", "bias_low", "bias_high",
    "variance", "pass_share",
)  # fmt: skip
"""Further columns of the page."""
LEVELS = {
    "right": Style(PALETTE[3], letter="+", meaning="derivative of its program, and near the model's gradient"),
    "own": Style(PALETTE[0], letter="o", meaning="derivative of its program, which is not near the model"),
    "noisy": Style(PALETTE[5], letter="~", meaning="derivative of its program, but averages are no better than 0"),
    "open": Style(
        PALETTE[4], letter="?", meaning="derivative of its program; whether averages are better than 0 is open"
    ),
    "wrong": Style(PALETTE[2], letter="x", meaning="not the derivative of its program, or not finite"),
    "none": Style("0.85", letter="-", meaning="no gradient, or the engine cannot run the scene"),
}
NOTES = (
    "Program error: distance of the gradient from differences of the engine's own cost. Model error: distance from rigid "
    "contact's gradient where it has a closed form, otherwise from the gradient of the scene's own program. RMSE: of "
    "`samples` averaged gradients, or costs with scores, relative to the engine's own grad J_sigma; where that is not "
    "known well enough, the upper end of the interval. Times are of a batch of 64 rollouts. Pipe: share of the gradients' "
    "time that is spent outside the engine's process.",
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the findings, the table with a line per scene and engine, and the grid of usable gradients."""
    arranged = arrange(experiment, rows)
    arranged = replace(arranged, rows=with_limits(arranged.rows))
    columns = experiment.columns.by_name
    columns = columns | {"rmse_rel": replace(columns["rmse_rel"], limit="rmse_is_limit")}
    own, details = ([columns[name] for name in names] for names in (SHOWN, DETAILS))
    lines = engine_table(experiment, rows, arranged, own, "gradients of physics engines", NOTES)
    measured = arranged.rows[arranged.rows["status"].isin(("ok", "nonfinite"))]
    if measured.empty:
        return Views(["No cell gave a result: the table has the reason of each."], [lines], remarks=reasons(rows))
    measured = measured.assign(
        engine=problem_names(arranged, ["backend"], always=["backend"], rows=measured),
        level=[level(row) for _, row in measured.iterrows()],
    )
    findings = [usable(measured), models(measured), costs(measured)]
    findings = [finding for finding in findings if finding]
    charts = [_chart(measured, headline(measured))]
    return Views(findings, [lines], charts, rows=arranged.rows, columns=[*own, *details], remarks=reasons(rows))


def level(row: pd.Series) -> str:
    """Return the level of a row's gradient, a key of :data:`LEVELS`."""
    if len(row["gradient"]) == 0:
        return "none"
    if row["status"] != "ok" or row["nan_share"] > 0 or not row["program_error_rel"] <= ACCURATE:
        return "wrong"
    low, high = rmse_interval(row)
    if low >= USELESS:
        return "noisy"
    if not high < USELESS:
        return "open"
    return "right" if row["model_error_rel"] <= SAME else "own"


def rmse_interval(row: pd.Series) -> tuple[float, float]:
    """Return an interval of at least 95% of a row's relative RMSE, from the intervals of bias, variance and norm.

    The variance's interval is that of normal numbers, one per repeat. The reference's error is in the interval of the bias,
    and makes that of the norm two standard errors wide. The upper end is infinite where the norm may be 0.
    """
    free = max(int(row["repeats"]) - 1, 1)
    low, high = (math.sqrt(row["variance"] * free / float(chdtri(free, tail))) for tail in (0.025, 0.975))
    reach, norm = 2.0 * row["reference_se"], row["reference_norm"]
    upper = math.hypot(row["bias_high"], high) / (norm - reach) if norm > reach else math.inf
    return math.hypot(row["bias_low"], low) / (norm + reach), upper


def with_limits(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the upper end of the RMSE's interval where the reference is not known well enough for the RMSE.

    The column ``rmse_is_limit`` is true there. Where the interval has no upper end the RMSE is missing.
    """
    known = rows["reference_norm"].notna()
    hidden = known & ~(rows["rmse_rel"] > 2.0 * rows["reference_se"] / rows["reference_norm"])
    limits = pd.Series({i: rmse_interval(row)[1] for i, row in rows[hidden].iterrows()}, dtype=float)
    shown = rows.assign(rmse_is_limit=hidden)
    shown.loc[hidden, "rmse_rel"] = limits.where(np.isfinite(limits))
    return shown


def usable(measured: pd.DataFrame) -> str:
    """Return on how many scenes each engine's gradient is the derivative of its program and better than 0 on average."""
    return (
        "Cells in which a gradient is the derivative of its engine's program, and averages of it are better than 0 (95% "
        f"interval): {_counts(measured)}."
    )


def _counts(measured: pd.DataFrame) -> str:
    """Return the counts of usable and of open gradients, with the engines that have them."""
    engines: dict[str, list[str]] = {}
    for engine, part in measured.groupby("engine", sort=False):
        good, undecided = int(part["level"].isin(("right", "own")).sum()), int((part["level"] == "open").sum())
        count = f"{good} of {len(part)}" + (f" and {undecided} open" if undecided else "")
        engines.setdefault(count, []).append(str(engine))
    return ", ".join(f"{count} ({', '.join(names)})" for count, names in engines.items())


def headline(measured: pd.DataFrame) -> str:
    """Return the title of the chart: the engines with usable gradients."""
    good = measured[measured["level"].isin(("right", "own"))]
    counts = [
        f"{engine} {len(part)} of {int((measured['engine'] == engine).sum())}"
        for engine, part in good.groupby("engine", sort=False)
    ]
    rest = [str(engine) for engine in measured["engine"].unique() if engine not in set(good["engine"])]
    names = ", ".join(rest) if len(rest) <= NAMED else f"the other {len(rest)}"
    others = f"; none known for {names}" if rest and counts else ""
    return f"Gradients that can be used: {', '.join(counts) or 'none'}{others}"


def models(measured: pd.DataFrame) -> str:
    """Return the gradients that match rigid contact where it has a closed form, and the largest distance."""
    rigid = measured[(measured["model"] == "rigid contact") & measured["model_error_rel"].notna()]
    if rigid.empty:
        return ""
    near = rigid[rigid["model_error_rel"] <= SAME]
    worst = rigid.loc[rigid["model_error_rel"].idxmax()]
    names = ", ".join(f"{row['engine']} on {row['scene']}" for _, row in near.iterrows()) or "none"
    return (
        f"Gradients within {number(SAME, 1)} of rigid contact's: {names}. The largest relative distance is "
        f"{number(worst['model_error_rel'])} ({worst['engine']} on {worst['scene']})."
    )


def costs(measured: pd.DataFrame) -> str:
    """Return the times of a batch of gradients by engine, and the largest share of the pipe."""
    timed = measured[measured["gradient_s"].notna()]
    if timed.empty:
        return ""
    texts = [f"{engine} {_range(part['gradient_s'])}" for engine, part in timed.groupby("engine", sort=False)]
    pipe = timed["pipe_share"].max()
    share = f" Pipes take up to {number(100 * pipe)}% of a gradient." if pipe == pipe else ""
    return f"64 gradients take: {', '.join(texts)}.{share}"


def _range(seconds: pd.Series) -> str:
    """Return the shortest and longest duration, or one if they are the same text."""
    return " to ".join(dict.fromkeys(duration(value) for value in (seconds.min(), seconds.max())))


def _chart(measured: pd.DataFrame, title: str) -> Chart:
    """Return the grid of engines and scenes, coloured by level, with the model error of each gradient."""
    several = measured["contact"].nunique() > 1
    places = [
        f"{row['scene']}, rigid" if several and row["contact"] == "impulse" else row["scene"]
        for _, row in measured.iterrows()
    ]
    frame = measured.assign(
        row=measured.index,
        place=places,
        cell=[
            f"{LEVELS[row['level']].letter} {number(row['model_error_rel'])}" if row["level"] != "none" else "-"
            for _, row in measured.iterrows()
        ],
    )
    return Chart(
        "engines", title, frame, [text("place", label="")], [text("engine", label="")], "grid",
        level="level", cell="cell", styles=LEVELS, height=0.3, across=1,
        subtitle="Number: model error, the relative distance from the model's gradient.",
        text="A cell per engine and scene (rigid: with the law impulse). An empty cell: the engine does not run it.",
    )  # fmt: skip
