"""The page of fits: what each record tells, errors and coverage by way of fitting."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd

from bench.experiment.experiment import Experiment
from bench.report.views import arranged
from bench.report.web import generic
from bench.report.web.content import Content, nothing_ran
from bench.studies.identify.report import failing, findings, flat, readable


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return what fails, a chart of any two numbers, and the table of fits."""
    made, shown = generic.content(experiment, rows), arranged(experiment, rows)
    lines = flat(shown)
    sentences = failing(lines) if len(lines) else findings(shown)
    said = nothing_ran(rows) or "; ".join(sentence.rstrip(".").replace("; ", ", ") for sentence in sentences)
    return replace(made, finding=said, answers=readable(lines), answers_title="What the records tell, and how fits did")
