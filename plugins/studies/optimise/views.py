"""What the study of searches shows: targets reached by method, and in how many rollouts."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from bench.experiment.axes import table
from bench.experiment.columns import Column, interval, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Table, Views
from bench.report.colours import estimator_colour, estimator_marker
from bench.report.style import VARIANTS

from . import aggregate
from .aggregate import RunSet

STEPS = 40
"""Number of points of a drawn curve."""
METHOD, PROBLEM = text("method"), text("problem")
REACHED = interval("reached", label="targets reached", format="percent", log=False)
SCORE = interval("score", digits=3, log=False)
BETTER = interval("improvement", label="beats fobg")
PROFILE = Column("profile", log=False)
MEDIAN = Column("median_score", label="median over tunings", log=False)
RUNTIME = interval(
    "art", label="average runtime", unit="rollouts", log=True,
    doc="expected rollouts per target reached: all rollouts of all searches over the searches that reached it",
)  # fmt: skip
RATE = interval("rate", label="searches that reach it")
SPENT = Column("spent", label="rollouts", log=True)
NOTE = (
    "targets reached: share of searches whose regret falls to 1/10, 1/100 and 1/1000 of the first, the mean over problems and "
    "targets. score: share of the way from the first cost to J*, interquartile mean over searches, with a bootstrap interval "
    "stratified by problem. beats fobg: chance of a lower final cost, paired by problem and seed. profile: integral of the "
    "share of targets reached within 1 to 4 times the best method's runtime. average runtime (aRT): expected rollouts per "
    "target reached, where a gradient counts as many rollouts as take its time: the rollouts of all searches over the number "
    "of searches that reached the target, inf if none did. Each method is shown at its best tuning on each problem, chosen by "
    "median final cost of {seeds}, next to the number of tunings and the median score over all of them. Methods without "
    "an estimator (dashed in charts) are context."
)
PAGE = (
    "stopped", "scene_class", "final_cost", "best_known", "score", "rollouts", "gradients", "search_s", "quality_rmse_rel",
    "quality_bias_share",
)  # fmt: skip


def views(experiment: Experiment, rows: pd.DataFrame) -> Views | None:
    """Return the tables and charts of the searches; None without any."""
    runs = aggregate.collect_runs(experiment, rows)
    if runs.rows.empty:
        return None
    cells = rows.assign(**{c: runs.rows[c] for c in ("problem", "method", "tuning", "best_known", "score")})
    cells = cells.fillna({"problem": "", "method": "", "tuning": ""}).astype({"score": float, "best_known": float})
    by_name = experiment.columns.by_name | {"best_known": Column("best_known", label="J*")}
    return Views(
        tables(experiment, rows, runs), charts(runs), rows=cells,
        columns=[METHOD, *(by_name[column] for column in PAGE)],
    )  # fmt: skip


# --------------------------------------------------------------------------------------------------------- tables


def tables(experiment: Experiment, rows: pd.DataFrame, runs: RunSet) -> list[Table]:
    """Return the tables of methods, of times to targets and of lowest costs."""
    reached, summary = aggregate.times_to_targets(runs), aggregate.summarise(runs)
    methods = summary.sort_values(["reached", "score"], ascending=False, kind="stable")
    methods = methods.assign(verdict=np.where(aggregate.is_tied(methods), "first or tied", ""))
    chosen = runs.tuning_seeds
    seeds = f"seeds {', '.join(map(str, chosen))}, which do not score" if chosen else "the same seeds that score"
    return [
        Table(
            "optimise", methods,
            [METHOD, REACHED, text("verdict"), SCORE, BETTER, PROFILE, *(Column(name, format="setting") for name in ("tunings", "searches", "diverged")), MEDIAN],
            "methods by the share of targets they reach", [NOTE.format(seeds=seeds)], terminal=True, page=True,
            data=table(experiment, rows),
        ),
        Table(
            "optimise", reached.assign(regret=[f"1/{t:g}" for t in reached["target"]]),
            [PROBLEM, METHOD, text("tuning"), text("regret"), RATE, RUNTIME], "Times to targets",
            terminal=True,
        ),
        Table(
            "optimise", runs.rows.drop_duplicates("problem"),
            [PROBLEM, text("scene_class", label="class"), Column("start_cost", label="J0", digits=6),
             Column("best_known", label="J*", digits=8), text("best_known_status", label="source of J*")],
            "Lowest costs", terminal=True,
        ),
        Table("targets", reached, [], files=["csv"]),
        Table("summary", summary, [], files=["csv"]),
    ]  # fmt: skip


# --------------------------------------------------------------------------------------------------------- charts


def styles(methods: Sequence[str]) -> dict[str, Style]:
    """Return the style of each method with an estimator: the estimator's colour."""
    looks: dict[str, Style] = {}
    uses: Counter[str] = Counter()
    for method in methods:
        if ", " in method:  # "estimator, optimizer"
            estimator = re.split(r"[\[,]", method)[0]
            turn = uses[estimator]
            uses[estimator] += 1
            dashes = VARIANTS[turn % len(VARIANTS)]
            looks[method] = Style(estimator_colour(estimator), estimator_marker(estimator, turn), dashes)
    return looks


def charts(runs: RunSet) -> list[Chart]:
    """Return the charts, the shares of targets reached first."""
    looks = styles(runs.rows["method"].unique())
    return [replace(chart, series="method", styles=looks) for chart in (_targets(runs), *_progress(runs))]


def _targets(runs: RunSet) -> Chart:
    """Return the share of targets that each method reaches, the largest first."""
    frame = aggregate.summarise(runs).sort_values("reached", ascending=False, kind="stable")
    return Chart(
        "targets", frame, [REACHED], [METHOD], "dots", height=0.24,
        subtitle=_where(runs, "targets: a tenth, a hundredth and a thousandth of the first regret"),
        text="Bars are 95% intervals over seeds.",
    )  # fmt: skip


def _where(runs: RunSet, what: str) -> str:
    problems = runs.rows["problem"].unique()
    return f"{len(problems)} problems, {what}" if len(problems) > 1 else f"{problems[0]}, {what}"


def _progress(runs: RunSet) -> list[Chart]:
    """Return the share of targets that single searches reach within a number of rollouts."""
    times = aggregate.runtimes(runs)
    finite = times.loc[np.isfinite(times["runtime"]) & (times["runtime"] > 0), "runtime"]
    if finite.empty:
        return []
    grid = np.geomspace(finite.min() / 1.5, finite.max() * 1.2, STEPS)
    shares = {
        method: [float(part["weight"][part["runtime"] <= x].sum()) for x in grid]
        for method, part in times.groupby("method", sort=False)
    }
    frame = pd.DataFrame(shares, index=pd.Index(grid, name="spent")).melt(
        var_name="method", value_name="share", ignore_index=False
    )
    share = Column("share", label="share of targets reached", format="percent", log=False)
    chart = Chart(
        "runtimes", frame.reset_index(), [SPENT], [share], height=2.6, panel="",
        subtitle=_where(runs, "single searches, a gradient counts as its time in rollouts"),
        text="Where a line ends is the share of targets reached in the whole budget.",
    )  # fmt: skip
    return [chart]
