"""Which charts an experiment gets: bias and variance along each swept axis, error against time, or an overview.

An estimator has one colour and marker in every chart, by its position among all registered estimators. Backends that
agree are one line. Relative means in units of the reference gradient's norm.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from bench.grid import Experiment
from bench.report.costs import ROLLOUTS, TIME, TIME_COMPILED, Cost
from bench.report.figures import save, styled
from bench.report.panels import bias_variance, overview, speed_accuracy
from bench.report.style import SYMBOLS, Look
from bench.report.views import CATEGORIES, Family, along, families, numeric_axes, ran, short_axis

ROOM = 4
"""Problems beyond which a chart shows some of them."""


def write(
    experiment: Experiment,
    rows: pd.DataFrame,
    axes: Sequence[str],
    names: Sequence[str],
    smoothing: Mapping[str, str] | None = None,
) -> list[Path]:
    """Draw every chart that the rows can fill, as PNG and SVG; returns the files' paths.

    ``axes`` are the swept axes; ``names`` all registered estimators in the order that fixes their colours;
    ``smoothing`` the parameter behind that column for each contact law.
    """
    paths = []
    with styled():
        for name, figure in figures(experiment, rows, axes, names, smoothing).items():
            figure.canvas.draw()
            figure.set_layout_engine("none")
            paths += save(figure, experiment.directory / name)
    return paths


def figures(
    experiment: Experiment,
    rows: pd.DataFrame,
    axes: Sequence[str],
    names: Sequence[str],
    smoothing: Mapping[str, str] | None = None,
) -> dict[str, Figure]:
    """The charts by file name."""
    look = Look(rows, names)
    seeds = rows["seed"].nunique()
    merged = [f"medians over {seeds} seeds"] if seeds > 1 else []
    found: dict[str, Figure] = {}

    def problems(axis: str | None, drawable: Callable[[pd.DataFrame], bool]) -> list[Family]:
        return [p for p in families(along(rows, axis, experiment), smoothing=smoothing) if drawable(p.rows)]

    for axis in numeric_axes(experiment, rows, axes):
        chosen, held = choose(problems(axis, lambda part: ran(part)["x"].nunique() > 1))
        if chosen:
            marks = experiment.marks.get(axis, experiment.marks.get(short_axis(axis), {}))
            name = re.sub(r"\W", "_", short_axis(axis))
            found[f"bias_variance_{name}"] = bias_variance(chosen, held + merged, look, axis, marks)
    nothing_swept = not found
    good = rows[rows["status"] == "ok"]
    if good["samples"].nunique() > 1 or good["backend"].nunique() > 1:
        for name, cost in (
            ("speed_accuracy", TIME_COMPILED if experiment.compile_time else TIME),
            ("rollouts_accuracy", ROLLOUTS),
        ):
            costed = problems("samples", partial(_costed, cost))
            curves = [problem for problem in costed if ran(problem.rows)["x"].nunique() > 1]
            chosen, held = choose(curves or costed)
            if chosen and (cost is not ROLLOUTS or good["samples"].nunique() > 1):
                found[name] = speed_accuracy(chosen, held + merged, look, cost)
    if nothing_swept:
        chosen = problems(None, lambda part: len(ran(part)) > 0)
        if chosen:
            found["overview"] = overview(chosen, merged, look)
    return found


def _costed(cost: Cost, rows: pd.DataFrame) -> bool:
    return len(cost.known(rows)) > 1


def choose(problems: Sequence[Family], room: int = ROOM) -> tuple[list[Family], list[str]]:
    """The problems to draw where there are more than fit, and of what is not drawn whole how many values are shown.

    Every scene and contact law is drawn. Of its numbers the one with most values gets the room that leaves, at even
    ranks among the values that were run most and not at their ends; the others are held at a middle one of those.
    """
    if len(problems) <= room:
        return list(problems), []
    kinds: dict[tuple[Any, ...], list[Family]] = {}
    for problem in problems:
        kinds.setdefault(tuple(problem.identity.get(k) for k in CATEGORIES), []).append(problem)
    kept = {p for members in kinds.values() for p in _thinned(members, problems, max(1, room // len(kinds)))}
    notes = []
    for name in _numbers(problems):
        every, drawn = ({p.identity[name] for p in some if name in p.identity} for some in (problems, kept))
        if drawn != every:
            notes.append(f"{len(drawn)} of {len(every)} values of {SYMBOLS.get(name, name)} shown")
    return [problem for problem in problems if problem in kept], notes


def _numbers(problems: Iterable[Family]) -> list[str]:
    return list(dict.fromkeys(k for p in problems for k in p.identity if k not in CATEGORIES))


def _thinned(members: Sequence[Family], problems: Sequence[Family], room: int) -> list[Family]:
    """The problems of one scene and contact law that :func:`choose` keeps."""

    def values(some: Iterable[Family], name: str) -> list[float]:
        return [float(problem.identity.get(name, -math.inf)) for problem in some]

    kept = list(members)
    for name in sorted(_numbers(members), key=lambda n: (-len(set(values(members, n))), n)):
        everywhere = Counter(values(problems, name))
        counts = {value: everywhere[value] for value in values(kept, name)}
        run_most = sorted(v for v, count in counts.items() if count == max(counts.values()))
        taken = min(room, len(run_most))
        wanted = {run_most[int((2 * i + 1) * len(run_most) / (2 * taken))] for i in range(taken)}
        kept = [problem for problem, value in zip(kept, values(kept, name), strict=True) if value in wanted]
        room //= taken
    return kept
