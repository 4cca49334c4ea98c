"""The page of fits: what each record tells, errors and coverage by way of fitting."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd

from bench.report.views import arranged
from bench.report.web import anything
from bench.report.web.content import Content, nothing_ran
from bench.studies.identify.report import findings, flat, readable
from bench.sweep.experiment import Experiment


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the findings, a chart of any two numbers, and the table of fits."""
    made, shown = anything.content(experiment, rows), arranged(experiment, rows)
    said = nothing_ran(rows) or "; ".join(sentence.rstrip(".").replace("; ", ", ") for sentence in findings(shown))
    return replace(
        made, finding=said, answers=readable(flat(shown)), answers_title="What the records tell, and how fits did"
    )
