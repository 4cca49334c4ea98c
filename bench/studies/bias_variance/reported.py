"""Summarises what rows report beside their errors: diagnostics of estimators, and references outside their tolerance."""

from __future__ import annotations

import json

import pandas as pd

from bench.report.text import counted, number
from bench.report.views import estimator_label

OFF = 0.5
"""Share of exact zeros above which a diagnostic counts as 0 in a cell."""


def sentences(rows: pd.DataFrame) -> list[str]:
    """Return a sentence per estimator and diagnostic: the range of its medians, and in how many cells it is mostly 0."""
    texts = []
    good = rows[(rows["status"] == "ok") & (rows["auxiliaries"] != "")]
    for (estimator, params), group in good.groupby(["estimator", "estimator_params"], sort=False):
        tables = [json.loads(text) for text in group["auxiliaries"]]
        for name in tables[0]:
            values = [table[name] for table in tables if name in table]
            medians = sorted(value["median"] for value in values)
            off = sum(value["zero"] > OFF for value in values)
            label = estimator_label(estimator, params)
            texts.append(
                f"{label}: {name} is {number(medians[0])} to {number(medians[-1])} (medians of {counted(len(values), 'cell')})"
                + (f", and 0 in most estimates of {off} of them: it does nothing there" if off else "")
            )
    return texts


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
