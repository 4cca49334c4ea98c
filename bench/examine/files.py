"""Writes the files of an examination: text, tables and charts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from bench.examine.findings import Findings
from bench.experiment.columns import Column
from bench.experiment.views import Chart, Mark
from bench.report.draw import draw
from bench.report.figures import save, styled
from bench.run.files import make_directory, write_all

SHOWN = 8
"""Most components drawn: those with the largest errors."""


def write(report: Findings, directory: Path) -> list[Path]:
    """Write the text, the tables and the charts into ``directory``, and return their paths.

    The files are ``report.txt``, ``derivatives.csv``, ``sigmas.csv``, ``breaks.csv``, the charts, and ``printed.txt`` where
    the cost prints.
    """
    make_directory(directory)
    tables = {"derivatives": report.frame, "sigmas": report.sigmas, "breaks": report.breaks}
    texts = {f"{name}.csv": table.to_csv(index=False, lineterminator="\n") for name, table in tables.items()}
    if report.printed:
        texts["printed.txt"] = "\n".join([*report.printed, ""])
    paths = write_all(directory, {"report.txt": f"{report}\n", **texts})
    with styled():
        for chart in charts(report):
            paths += save(draw(chart), directory / chart.name, data=chart.plotted())
    return paths


def charts(report: Findings) -> list[Chart]:
    """Return the charts for which the report has data: steps and lines."""
    found = []
    if report.check.parts and report.gradient:
        parts = sorted(report.check.parts, key=lambda part: -np.nan_to_num(part.error, nan=np.inf))[:SHOWN]
        steps = pd.concat(
            [
                pd.DataFrame(
                    {
                        "derivative": report.label(part),
                        "step": part.sample.step / part.sample.scale,
                        "error": part.sample.errors,
                    }
                )
                for part in parts
            ]
        )
        found.append(
            Chart(
                "steps",
                steps,
                [Column("step", label="step, in units of the input's scale", log=True)],
                [Column("error", label="relative error of the gradient", log=True)],
                series="derivative",
                title="The gradient against differences of the cost",
                subtitle="falls with the step squared until rounding where the gradient is right; levels off where it is wrong",
            )
        )
    if report.lines:
        lines = pd.concat(
            [
                pd.DataFrame({"line": f"line {i + 1}", "t": line.at, "cost": line.costs})
                for i, line in enumerate(report.lines)
            ]
        )
        marks = [
            Mark(f"{b.kind}", b.at, panel=f"line {i + 1}") for i, line in enumerate(report.lines) for b in line.breaks
        ]
        found.append(
            Chart(
                "lines",
                lines,
                [Column("t", label="t, in sigma")],
                [Column("cost")],
                panel="line",
                marks=marks,
                title="The cost on lines through theta",
            )
        )
    return found
