"""Summarises the diagnostics that estimators report, such as a weight: where it is 0, the method has no effect."""

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
