"""What the main study shows of its rows: comparisons with intervals, and the tables and charts from them."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd

from bench.experiment.experiment import Experiment
from bench.experiment.views import Views
from bench.report.text import counted
from bench.report.views import arrange

from . import charts, tables, time_to_accuracy
from .columns import COLUMNS
from .comparisons import compare_errors, method_table
from .costs import with_gradient_cost

RESULTS = ("variance", "cosine", "rollouts", "gradients", "reference_method")


def views(experiment: Experiment, rows: pd.DataFrame) -> Views | None:
    """Return the tables and charts of the rows; None if no cell was run."""
    shown = arrange(experiment, with_gradient_cost(rows))
    methods = method_table(shown)
    if methods.empty:
        return None
    errors = compare_errors(methods)
    best = time_to_accuracy.table(shown)
    comparisons = errors if best.empty else pd.concat([errors, time_to_accuracy.comparisons(best)], ignore_index=True)
    all_tables = tables.tables(experiment, rows, shown, methods, comparisons)
    all_tables += [] if best.empty else [time_to_accuracy.accuracy_table(best)]
    return Views(
        all_tables,
        charts.charts(shown, methods, errors, best),
        rows=charts.with_plotted_columns(with_gradient_cost(rows)),
        columns=[
            *(replace(c, label=label) for c, label in ((charts.RMSE, "rel. RMSE"), (charts.BIAS, "rel. bias"))),
            replace(COLUMNS.by_name["time_s"], label="time"),
            *(COLUMNS.by_name[name] for name in RESULTS),
        ],
        remarks=loose_references(rows, experiment.reference.tolerance),
    )


def loose_references(rows: pd.DataFrame, tolerance: float) -> list[str]:
    """Return in how many cells the reference's relative standard error is above the experiment's ``tolerance``, and the largest."""
    good = rows[(rows["status"] == "ok") & (rows["reference_norm"] > 0)]
    error = good["reference_se"] / good["reference_norm"]
    loose = error[error > tolerance]
    if loose.empty:
        return []
    return [
        f"the standard error of the reference is above its tolerance of {100 * tolerance:g}% in {counted(len(loose), 'cell')}, up to "
        f"{100 * loose.max():.2g}% ({good.loc[loose.idxmax(), 'scene']}): more reference.samples make it smaller"
    ]
