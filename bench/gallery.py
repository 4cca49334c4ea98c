"""Writes the gallery: the main chart of each experiment, and in one sentence what it shows.

``python -m bench.gallery docs/gallery.md results/standard`` writes it from the stored rows of any results directory.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from bench.errors import UserError
from bench.experiment import config
from bench.experiment.experiment import Experiment
from bench.experiment.study import study_of
from bench.report.tables import escape_markdown
from bench.report.views import latest
from bench.report.web import content
from bench.run.execute import store_of
from bench.run.files import make_directory, write_whole

DEFAULTS = "docs/gallery.md", "results/standard"
MARKS = "<!-- gallery -->", "<!-- end of gallery -->"
NEW = f"# Gallery\n\nWhat each experiment shows.\n\n{MARKS[0]}\n\n{MARKS[1]}\n"
"""The page to start from if there is none."""


def main(page: Path, results: Path) -> list[str]:
    """Write the gallery of all experiments with rows under a directory into a page; returns their names.

    The gallery stands between two marks. An experiment without stored rows keeps its present part of the page. Raises
    :class:`UserError` where there is nothing to show, or no place for it.
    """
    text = page.read_text() if page.exists() else NEW
    place = re.search(f"{MARKS[0]}(.*?){MARKS[1]}", text, re.DOTALL)
    if place is None:
        raise UserError(f"'{page}' has no place for the gallery: put {MARKS[0]} and {MARKS[1]} into it")
    kept = {part.partition("\n")[0].strip("` "): part for part in place[1].split("\n### ")[1:]}
    parts = {}
    for name in config.experiments():
        experiment = config.load([f"experiment={name}", f"results_dir={results}"])
        part = entry(experiment, page.parent) or kept.get(name)
        if part:
            parts[name] = part.strip()
    if not parts:
        raise UserError(f"'{results}' has no rows of any experiment: run some with results_dir={results} first")
    gallery = "".join(f"\n### {part}\n" for part in parts.values())
    make_directory(page.parent)
    write_whole(page, (text[: place.start()] + f"{MARKS[0]}\n{gallery}\n{MARKS[1]}" + text[place.end() :]).encode())
    return list(parts)


def entry(experiment: Experiment, folder: Path) -> str:
    """Return name, question, chart and finding; nothing without rows. Paths of pictures are relative to ``folder``."""
    rows = latest(store_of(experiment).load())
    if rows.empty:
        return ""
    finding = escape_markdown(content(experiment, rows).finding)
    chart = main_chart(experiment, study_of(experiment).chart(experiment, rows))
    picture = f"![{experiment.name}]({Path(os.path.relpath(chart, folder)).as_posix()})" if chart else ""
    return "\n\n".join(filter(None, [f"`{experiment.name}`", experiment.question, picture, finding]))


def main_chart(experiment: Experiment, names: Sequence[str]) -> Path | None:
    """Return the first existing chart of those named, else the first chart of all; None where there is none."""
    wanted = (experiment.directory / f"{name}.png" for name in names)
    there = (path for path in (*wanted, *sorted(experiment.directory.glob("*.png"))) if path.exists())
    return next(there, None)


if __name__ == "__main__":
    words = sys.argv[1:]
    try:
        if len(words) > len(DEFAULTS):
            raise UserError("name the page and the results: python -m bench.gallery docs/gallery.md results/standard")
        page, results = (Path(word).expanduser() for word in (*words, *DEFAULTS[len(words) :]))
        print(f"{page}: {', '.join(main(page, results))}")
    except (UserError, OSError) as error:
        sys.exit(f"gallery: {error}")
