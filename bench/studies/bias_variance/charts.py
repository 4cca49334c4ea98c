"""Chooses an experiment's charts: bias and variance along each swept axis, error against time, or an overview.

An estimator has the same colour and marker in every chart, by its position among all registered estimators. Backends
that agree are drawn as one line. Relative errors are in units of the reference gradient's norm.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from bench.experiment.axes import Axis
from bench.experiment.experiment import Experiment
from bench.model import SURROGATE, registry
from bench.report.cores import run_tasks
from bench.report.figures import save, styled
from bench.report.problems import ProblemRows, split_by_problem
from bench.report.style import Styles, plain, symbol
from bench.report.views import CATEGORIES, arrange, attempted
from bench.studies.bias_variance import time_to_accuracy
from bench.studies.bias_variance.costs import ROLLOUTS, TIME, TIME_COMPILED, Cost, with_gradient_cost
from bench.studies.bias_variance.error_against_time import FEWEST, draw_error_against_time
from bench.studies.bias_variance.panels import bias_variance, overview, speed_accuracy
from bench.studies.bias_variance.summary_matrix import draw_summary_matrix
from bench.studies.bias_variance.time_to_accuracy import SAMPLES

ROOM = 4
"""Most problems in one chart."""


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write every chart that the rows have data for, in the experiment's formats; return the files' paths."""

    def drawn(name: str, figure: Callable[[], Figure]) -> list[Path]:
        with styled():
            chart = figure()
            chart.draw_without_rendering()  # computes the layout, once
            chart.set_layout_engine(None)
            return save(chart, experiment.directory / name, experiment.formats)

    tasks = [partial(drawn, name, figure) for name, figure in chart_drawers(experiment, rows).items()]
    return [path for paths in run_tasks(tasks) for path in paths]


def file_name(axis: Axis, kind: str = "bias_variance") -> str:
    """Return the file name, without extension, of the chart along an axis."""
    return f"{kind}_" + re.sub(r"\W", "_", axis.column)


def along_longest(experiment: Experiment, rows: pd.DataFrame) -> list[str]:
    """Return the names of the charts along swept axes, the longest axis first."""
    swept = arrange(experiment, rows).swept()
    return [file_name(axis) for axis in sorted(swept, key=lambda axis: -swept[axis])]


def figures(experiment: Experiment, rows: pd.DataFrame) -> dict[str, Figure]:
    """Return the charts as figures, by file name without extension."""
    with styled():
        return {name: figure() for name, figure in chart_drawers(experiment, rows).items()}


def chart_drawers(experiment: Experiment, rows: pd.DataFrame) -> dict[str, Callable[[], Figure]]:
    """Return the functions that draw the charts, by file name without extension."""
    shown = arrange(experiment, with_gradient_cost(rows))
    rows = shown.rows
    look = Styles(rows, sorted(registry.entries()["estimators"]))
    seeds = rows["seed"].nunique()
    merged = [f"medians over {seeds} seeds"] if seeds > 1 else []
    for law in rows.loc[rows["reason"].str.contains(SURROGATE, regex=False), "contact"].unique():
        merged.append(f"{plain(law)}: {SURROGATE}")
    drawers: dict[str, Callable[[], Figure]] = {}

    def problems(axis: Axis | None, drawable: Callable[[pd.DataFrame], bool]) -> list[ProblemRows]:
        return [p for p in split_by_problem(shown, axis) if drawable(p.rows)]

    swept = shown.swept()
    for axis in swept:
        chosen, held = choose_problems(problems(axis, lambda part: attempted(part)["x"].nunique() > 1))
        if chosen:
            drawers[file_name(axis)] = partial(bias_variance, chosen, held + merged, look, axis, shown.marks(axis))
    nothing_swept = not drawers
    good = rows[rows["status"] == "ok"]
    # sigma is excluded: it changes an estimate but not its time
    longest = max((axis for axis in swept if axis.short != "sigma"), key=lambda axis: swept[axis], default=None)
    if longest is not None and good["samples"].nunique() < 2 and good["time_s"].notna().any():
        chosen, held = choose_problems(problems(longest, lambda part: TIME.known(part)["x"].nunique() >= FEWEST))
        if chosen:
            drawers[file_name(longest, "time")] = partial(draw_error_against_time, chosen, held + merged, look, longest)
    if good["samples"].nunique() > 1 or good["backend"].nunique() > 1:
        for name, cost in (
            ("speed_accuracy", TIME_COMPILED if experiment.compile_time else TIME),
            ("rollouts_accuracy", ROLLOUTS),
        ):
            costed = problems(SAMPLES, partial(_has_costs, cost))
            curves = [problem for problem in costed if attempted(problem.rows)["x"].nunique() > 1]
            chosen, held = choose_problems(curves or costed)
            if chosen and (cost is not ROLLOUTS or good["samples"].nunique() > 1):
                drawers[name] = partial(_costs, chosen, held + merged, look, cost)
        swept_in_samples = (
            problems(SAMPLES, lambda part: attempted(part)["x"].nunique() > 1) if good["samples"].nunique() > 1 else []
        )
        if swept_in_samples:
            costs = [TIME, ROLLOUTS] if good["time_s"].notna().any() else [ROLLOUTS]
            drawers["summary_matrix"] = partial(
                draw_summary_matrix, choose_problems(swept_in_samples, 2 * ROOM)[0], costs
            )
    if nothing_swept:
        chosen = problems(None, lambda part: len(attempted(part)) > 0)
        if chosen:
            drawers["overview"] = partial(overview, chosen, merged, look)
    return drawers


def _costs(problems: Sequence[ProblemRows], notes: Sequence[str], look: Styles, cost: Cost) -> Figure:
    return speed_accuracy(problems, notes, look, cost, *_panel_sentences(problems, cost))


def _panel_sentences(problems: Sequence[ProblemRows], cost: Cost) -> tuple[dict[int, str], str]:
    """Return a text per problem (by its position) on which method reaches 10% and 1% error first, and the chart's title.

    If samples were not swept, there are no texts, and the title names the most accurate and the cheapest estimator.
    """
    kind = "rollouts" if cost is ROLLOUTS else "time"
    sentences = {}
    every: list[dict[str, Any]] = []
    for place, problem in enumerate(problems):
        if problem.rows["x"].nunique() > 1:
            entries = [time_to_accuracy.line(problem, target, kind, cost) for target in time_to_accuracy.TARGETS]
            sentences[place] = "\n".join(map(time_to_accuracy.sentence, entries))
            every += entries
    if every:
        return sentences, time_to_accuracy.summarise_leaders(every)
    return sentences, time_to_accuracy.summarise_accuracy_and_cost(problems, cost)


def _has_costs(cost: Cost, rows: pd.DataFrame) -> bool:
    return len(cost.known(rows)) > 1


def choose_problems(problems: Sequence[ProblemRows], room: int = ROOM) -> tuple[list[ProblemRows], list[str]]:
    """Return the problems to draw, about ``room`` of them, and notes on how many values of each parameter are shown.

    Every combination of categories (scene, contact law, integrator, noise) is drawn. The parameter with most values
    gets the remaining panels, at evenly spaced ranks among its most frequent values, not at the ends of their range.
    Other parameters are fixed at a middle value among their most frequent ones.
    """
    if len(problems) <= room:
        return list(problems), []
    kinds: dict[tuple[Any, ...], list[ProblemRows]] = {}
    for problem in problems:
        kinds.setdefault(tuple(problem.identity.get(k) for k in CATEGORIES), []).append(problem)
    kept = {p for members in kinds.values() for p in _choose_values(members, problems, max(1, room // len(kinds)))}
    notes = []
    for name in _numbers(problems):
        every, drawn = ({p.identity[name] for p in some if name in p.identity} for some in (problems, kept))
        if drawn != every:
            notes.append(f"{len(drawn)} of {len(every)} values of {symbol(name) or name} shown")
    return [problem for problem in problems if problem in kept], notes


def _numbers(problems: Iterable[ProblemRows]) -> list[str]:
    return list(dict.fromkeys(k for p in problems for k in p.identity if k not in CATEGORIES))


def _choose_values(members: Sequence[ProblemRows], problems: Sequence[ProblemRows], room: int) -> list[ProblemRows]:
    """Return the problems that :func:`choose_problems` draws of one combination of categories, at most ``room``."""

    def values(some: Iterable[ProblemRows], name: str) -> list[float]:
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
