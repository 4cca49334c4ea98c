"""The README's gallery: the main chart of each experiment, and in one sentence what it shows.

``python -m bench.report.gallery README.md results`` writes it again from stored rows, between its two marks.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pandas as pd

from bench import config, grid, report
from bench.errors import UserError
from bench.grid import Experiment
from bench.report import web
from bench.report.tables import escape_markdown
from bench.report.views import numeric_axes, short_axis

MARKS = "<!-- gallery -->", "<!-- end of gallery -->"


def main(readme: Path, results: Path) -> None:
    """Put the gallery into the README; an experiment without stored rows keeps what is told of it."""
    text = readme.read_text()
    found = re.search(f"{MARKS[0]}(.*?){MARKS[1]}", text, re.DOTALL)
    if found is None:
        raise UserError(f"'{readme}' has no place for the gallery: put {MARKS[0]} and {MARKS[1]} into it")
    told = {part.partition("\n")[0].strip("` "): part for part in found[1].split("\n### ")[1:]}
    parts = []
    for name in config.experiments():
        experiment = config.load([f"experiment={name}", f"results_dir={results}"])
        rows = experiment.directory / "rows.parquet"
        part = entry(experiment, report.latest(pd.read_parquet(rows))) if rows.exists() else told.get(name)
        if part:
            parts.append(part.strip())
    gallery = "".join(f"\n### {part}\n" for part in parts)
    readme.write_text(text[: found.start()] + f"{MARKS[0]}\n{gallery}\n{MARKS[1]}" + text[found.end() :])


def entry(experiment: Experiment, rows: pd.DataFrame) -> str:
    """Title, question, chart and finding."""
    axes = grid.swept(experiment.sweep)
    finding = web.content(experiment, rows, axes).finding
    chart = main_chart(experiment, rows, axes)
    picture = f"![{experiment.name}]({chart.as_posix()})\n\n" if chart else ""
    return f"`{experiment.name}`\n\n{experiment.question}\n\n{picture}{escape_markdown(finding)}"


def main_chart(experiment: Experiment, rows: pd.DataFrame, axes: list[str]) -> Path | None:
    """The chart named after the experiment, after its study or along its longest axis; else the first there is."""
    swept = numeric_axes(experiment, rows, axes) if experiment.study == "bias_variance" else {}
    longest = sorted(swept, key=lambda axis: -swept[axis])
    stems = [experiment.name, experiment.study, *(f"bias_variance_{short_axis(axis)}" for axis in longest)]
    wanted = [experiment.directory / f"{stem}.png" for stem in stems]
    there = [path for path in (*wanted, *sorted(experiment.directory.glob("*.png"))) if path.exists()]
    return there[0] if there else None


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]), Path(sys.argv[2]))
    except (UserError, IndexError, OSError) as error:
        sys.exit(f"gallery: {error or 'name the README and the results'}")
