"""Sentences on what estimators report of themselves: a weight that is 0 switches a method off."""

from __future__ import annotations

import json

import pandas as pd

from bench.report.text import counted, number

OFF = 0.5
"""Share of exact zeros from which an auxiliary is said to switch its estimator off."""


def sentences(rows: pd.DataFrame) -> list[str]:
    """Return, per estimator and auxiliary, the range of its medians over cells, and in how many cells it is mostly 0."""
    said = []
    good = rows[(rows["status"] == "ok") & (rows["auxiliaries"] != "")]
    for (estimator, params), group in good.groupby(["estimator", "estimator_params"], sort=False):
        tables = [json.loads(text) for text in group["auxiliaries"]]
        for name in tables[0]:
            values = [table[name] for table in tables if name in table]
            medians = sorted(value["median"] for value in values)
            off = sum(value["zero"] > OFF for value in values)
            label = f"{estimator}[{params}]" if params else estimator
            said.append(
                f"{label}: {name} is {number(medians[0])} to {number(medians[-1])} (medians of {counted(len(values), 'cell')})"
                + (f", and 0 in most estimates of {off} of them: it does nothing there" if off else "")
            )
    return said


def show(rows: pd.DataFrame) -> None:
    """Print the sentences."""
    for sentence in sentences(rows):
        print(f"  {sentence}")
