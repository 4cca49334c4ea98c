"""What the study of engines shows: which engine's gradient can be used on which scene, its errors and its costs."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.special import chdtri

from bench.experiment.columns import text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Views
from bench.report.shown import Shown
from bench.report.style import PALETTE
from bench.report.text import number

ACCURATE = 0.02
"""Relative program error up to which a gradient counts as the derivative of its program. Differences of float32 costs
have two digits."""
SAME = 0.1
"""Relative model error up to which a gradient counts as the gradient of the model."""
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
    "known well enough, the upper end of the interval. Times are of `batch` rollouts. Pipe: share of the gradients' "
    "time that is spent outside the engine's process.",
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the table with a line per scene and engine, and the grid of usable gradients."""
    shown = Shown(experiment, rows)
    cells = with_limits(shown.rows)
    measured = cells["status"].isin(("ok", "nonfinite"))
    cells = cells.assign(level=np.where(measured, levels(cells), ""))
    columns = experiment.columns.by_name | {
        "rmse_rel": shown.column("rmse_rel", label="RMSE, gradients", limit="rmse_is_limit")
    }
    own, details = ([columns[name] for name in names] for names in (SHOWN, DETAILS))
    table = shown.cells([text("level", label="gradient"), *own], "gradients of physics engines", NOTES, rows=cells)
    charts = [_chart(cells[measured])] if measured.any() else []
    return Views([table], charts, with_limits(shown.arranged.rows), [*own, *details])


def levels(rows: pd.DataFrame) -> np.ndarray:
    """Return the level of each row's gradient, a key of :data:`LEVELS`."""
    low, high = rmse_interval(rows)
    is_right = (rows["status"] == "ok") & ~(rows["nan_share"] > 0) & (rows["program_error_rel"] <= ACCURATE)
    kinds = {
        "none": rows["gradient"].map(len) == 0, "wrong": ~is_right, "noisy": low >= USELESS, "open": ~(high < USELESS),
        "right": rows["model_error_rel"] <= SAME,
    }  # fmt: skip
    return np.select(list(kinds.values()), list(kinds), "own")


def rmse_interval(rows: pd.DataFrame) -> tuple[pd.Series, pd.Series]:
    """Return an interval of at least 95% of each relative RMSE, from the intervals of bias, variance and norm.

    The variance's interval is that of normal numbers, one per repeat. The reference's error is in the interval of the bias,
    and makes that of the norm two standard errors wide. The upper end is infinite where the norm may be 0.
    """
    free = np.maximum(rows["repeats"] - 1, 1)
    low, high = (np.sqrt(rows["variance"] * free / chdtri(free, tail)) for tail in (0.025, 0.975))
    reach, norm = 2.0 * rows["reference_se"], rows["reference_norm"]
    upper = np.hypot(rows["bias_high"], high) / (norm - reach)
    return np.hypot(rows["bias_low"], low) / (norm + reach), upper.where(norm > reach, np.inf)


def with_limits(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the upper end of the RMSE's interval where the reference is not known well enough for the RMSE.

    The column ``rmse_is_limit`` is true there. Where the interval has no upper end the RMSE is missing.
    """
    known = rows["reference_norm"].notna()
    hidden = known & ~(rows["rmse_rel"] > 2.0 * rows["reference_se"] / rows["reference_norm"])
    limit = rmse_interval(rows)[1].replace(np.inf, np.nan)
    return rows.assign(rmse_is_limit=hidden, rmse_rel=rows["rmse_rel"].mask(hidden, limit))


def _chart(measured: pd.DataFrame) -> Chart:
    """Return the grid of engines and scenes, coloured by level, with the model error of each gradient."""
    rigid = (measured["contact"] == "impulse") & (measured["contact"].nunique() > 1)
    letters = measured["level"].map({name: style.letter for name, style in LEVELS.items()})
    errors = (" " + measured["model_error_rel"].map(number)).mask(measured["level"] == "none", "")
    frame = measured.assign(place=measured["scene"] + rigid.map({True: ", rigid", False: ""}), cell=letters + errors)
    return Chart(
        "engines", frame, [text("place", label="")], [text("method", label="")], "grid",
        level="level", cell="cell", styles=LEVELS, height=0.3, across=1,
        subtitle="Number: model error, the relative distance from the model's gradient.",
        text="A cell per engine and scene (rigid: with the law impulse). An empty cell: the engine does not run it.",
    )  # fmt: skip
