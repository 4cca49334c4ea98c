"""Shows how far each backend has come on the ladder of an experiment's scenes."""

from __future__ import annotations

import pandas as pd

from bench.experiment.columns import text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Table
from bench.run.ladder import fault_of

COLUMNS = (text("backend"), text("rung"), text("verdict"), text("reason"))


def table(experiment: Experiment, rows: pd.DataFrame) -> Table:
    """Return a line per backend and rung, the lowest first: passed, failed with its reason, or not started."""
    lines = []
    for backend, part in rows.groupby("backend", sort=False):
        failed = False
        for rung in dict.fromkeys(part["scene"]):
            reason = "" if failed else fault_of(experiment.study, part[part["scene"] == rung])
            verdict = "not started" if failed else "failed" if reason else "passed"
            lines.append((backend, rung, verdict, reason))
            failed = failed or bool(reason)
    names = [column.name for column in COLUMNS]
    return Table("ladder", pd.DataFrame(lines, columns=names), COLUMNS, "How far up", terminal=True, page=True)
