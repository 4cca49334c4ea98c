"""Builds the page of fits: identifiable parameters, errors and coverage by shooting method."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd

from bench.experiment.experiment import Experiment
from bench.report.views import arrange
from bench.report.web import old_generic as generic
from bench.report.web.content import Content, no_result_sentence
from bench.studies.identify.report import failures, findings, flatten, readable


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the content of the page: the failures, a chart of any two numbers, and the table of fits."""
    shown = arrange(experiment, rows)
    lines = flatten(shown)
    sentences = failures(lines) if len(lines) else findings(shown)
    return replace(
        generic.content(experiment, rows),
        finding=no_result_sentence(rows) or " ".join(sentences),
        answers=readable(lines),
        answers_title="Identifiable parameters, and precision of the fits",
    )
