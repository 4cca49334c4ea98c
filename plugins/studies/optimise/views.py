"""What the study of searches shows: scores, and targets reached, by method, and in how many rollouts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis, table
from bench.experiment.columns import Column, interval, setting, text
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import named
from bench.experiment.views import Chart, Table, Views
from bench.host.parameters import remember
from bench.measure import performance
from bench.measure.statistics import ends
from bench.report.problems import problem_names, titled
from bench.report.views import arrange, attempted, estimator_labels

from .. import PARTS

TARGETS = (10.0, 100.0, 1000.0)
"""Target regrets: the first regret divided by each of these factors."""
LEAST_REGRET = 1e-12
"""Smallest regret, as a share of the first regret: a smaller regret is rounding."""


METHOD, PROBLEM = text("method"), text("problem")
REACHED = interval(
    "reached",
    label="targets reached",
    format="percent",
    log=False,
    ends="95% interval over scenes, or over seeds of one",
)
SCORE = interval("score", digits=3, log=False)
NOTE = (
    "targets reached: share of searches whose regret falls to 1/10, 1/100 and 1/1000 of the first, the mean over problems and "
    "targets. score: share of the way from the first cost to J*, interquartile mean over searches. Intervals are over scenes, "
    "whose problems are not independent, and for one scene over its searches. beats fobg: chance of a lower final cost, paired by problem and seed. profile: integral of the "
    "share of targets reached within 1 to 4 times the best method's runtime. average runtime (aRT): expected rollouts per "
    "target reached, where a gradient counts as many rollouts as take its time: the rollouts of all searches over the number "
    "of searches that reached the target, inf if none did. Each method is shown at its best tuning on each problem, chosen by "
    "median final cost of {seeds}, next to the number of tunings and the median score over all of them. Methods without "
    "an estimator (dashed in charts) are context."
)
PAGE = (
    "stopped",
    "scene_class",
    "final_cost",
    "best_known",
    "score",
    "rollouts",
    "gradients",
    "search_s",
    "quality_rmse_rel",
    "quality_bias_share",
)


@dataclass(frozen=True, eq=False)
class RunSet:
    """The searches of an experiment, by problem, method and tuning.

    ``rows`` has the columns ``problem``, ``method``, ``tuning`` (the optimizer's swept parameters as a string),
    ``best_known`` (J*, or the lowest cost of any search if lower), ``best_known_status`` (its source), ``score`` and ``ratio``,
    the rollouts that take as long as one gradient: the median over searches, or what one counts as in the budget.
    """

    rows: pd.DataFrame
    tuned: Sequence[Axis] = ()
    """The swept parameters of optimizers."""

    @cached_property
    def scenes(self) -> pd.Series:
        """The name of each problem's scene, without its parameters."""
        return self.rows.drop_duplicates("problem").set_index("problem")["scene"].str.partition("[")[0]

    @cached_property
    def tuning_seeds(self) -> tuple[int, ...]:
        """The seeds that choose the tunings and do not score: the first third. Empty without tunings or with few seeds."""
        seeds = sorted(int(seed) for seed in self.rows["seed"].unique())
        several = (self.rows.groupby(["problem", "method"])["tuning"].nunique() > 1).any()
        # four seeds or more are split: some choose the tunings, the others score
        return tuple(seeds[: math.ceil(len(seeds) / 3)]) if several and len(seeds) >= 4 else ()

    @cached_property
    def best_tunings(self) -> dict[tuple[str, str], str]:
        """The tuning with the lowest median final cost, by problem and method.

        The median is over the tuning seeds, or over all seeds if there are no tuning seeds. A failed search counts as
        inf.
        """
        rows = self.rows[self.rows["seed"].isin(self.tuning_seeds)] if self.tuning_seeds else self.rows
        final = rows["final_cost"].where(rows["status"] == "ok", math.inf).fillna(math.inf)
        # the lower of the two middle costs, because their mean is infinite if one search failed
        groups = final.groupby([rows[n] for n in ("problem", "method", "tuning")], sort=False)
        middle = groups.quantile(interpolation="lower")
        best = middle.reset_index("tuning").sort_values("final_cost", kind="stable")["tuning"]
        return dict(best[~best.index.duplicated()])

    @cached_property
    def best_runs(self) -> pd.DataFrame:
        """The rows of each method's best tuning on each problem, without the tuning seeds."""
        rows = self.rows[~self.rows["seed"].isin(self.tuning_seeds)]
        best = pd.MultiIndex.from_frame(rows[["problem", "method"]]).map(self.best_tunings)
        return rows[rows["tuning"] == best]


def collect_runs(experiment: Experiment, rows: pd.DataFrame) -> RunSet:
    """Return the searches that ran, with names of problem, method and tuning, and scores."""
    shown = arrange(experiment, rows)
    runs = attempted(shown.rows)
    runs = runs[np.isfinite(runs["start_cost"])]
    tuned_axes = [
        axis
        for axis in shown.axes
        if any(part == "optimizer" for part, _, _ in named(runs, axis.names).dropna(axis=1, how="all"))
    ]
    names = problem_names(shown, PARTS, tuned_axes, rows=runs).astype(str)
    short = {axis.column: axis.short for axis in tuned_axes}
    tuning = titled(runs[[*short]].rename(columns=short), [*short.values()])
    runs = runs.assign(problem=names, estimator_label=estimator_labels(runs), tuning=tuning)
    runs = runs.assign(method=titled(runs, ["estimator_label", "optimizer"]))
    best_known, status = _best_known_cost(runs)
    start, final = runs["start_cost"], runs["final_cost"]
    achievable = (start - best_known).where(start > best_known)
    score = ((start - final) / achievable).clip(0.0, 1.0).mask(runs["status"] != "ok", 0.0)
    ratio = runs.groupby("problem")["gradient_ratio"].transform("median").fillna(experiment.study.gradient_cost)
    return RunSet(runs.assign(best_known=best_known, best_known_status=status, score=score, ratio=ratio), tuned_axes)


def _best_known_cost(rows: pd.DataFrame) -> tuple[pd.Series, pd.Series]:
    """Return, per row, the lowest cost known for its problem, and its source: J*, or a search that reached a lower cost."""
    lowest = rows.groupby("problem")["best_cost"].transform("min")
    known = rows["optimum"]
    below = known.isna() | (lowest < known - 1e-9 * known.abs())
    status = rows["optimum_status"].mask(known.isna(), "lowest cost of any search")
    status = status.mask(below & known.notna(), "lowest cost of any search, below J*: " + rows["optimum_status"])
    return known.mask(below, lowest), status


# ------------------------------------------------------------------------------------------------------- tables


@remember
def hits(runs: RunSet) -> pd.DataFrame:
    """Return a line per search and target: the rollouts until it is reached, of the whole search if not, and whether.

    Reached is where the regret J(theta_t) - J* is at most the first regret over the target.
    """
    lines = []
    for row in runs.best_runs.to_dict("records"):
        spent = np.asarray(row["path_rollouts"], dtype=float) + row["ratio"] * np.asarray(
            row["path_gradients"], dtype=float
        )
        rounding = LEAST_REGRET * max(abs(row["start_cost"] - row["best_known"]), 1e-300)
        regret = np.maximum(np.asarray(row["path_cost"], dtype=float) - row["best_known"], rounding)
        for target in TARGETS:
            below = np.flatnonzero(regret <= regret[0] / target)
            lines.append([row["problem"], row["method"], target, spent[below[0] if below.size else -1], below.size > 0])
    return pd.DataFrame(lines, columns=["problem", "method", "target", "spent", "reached"])


@remember
def times_to_targets(runs: RunSet) -> pd.DataFrame:
    """Return, per problem, method and target, successes with Wilson's interval and the average runtime in rollouts."""
    lines = []
    for (problem, method, target), part in hits(runs).groupby(["problem", "method", "target"], sort=False):
        costs, reached = part["spent"].to_numpy(), part["reached"].to_numpy()
        lines.append(
            {
                "problem": problem,
                "method": method,
                "tuning": runs.best_tunings[problem, method],
                "target": target,
                "successes": int(reached.sum()),
                "searches": len(reached),
                **ends("rate", (float(reached.mean()), *performance.wilson(int(reached.sum()), len(reached)))),
                **ends(
                    "art", (performance.average_runtime(costs, reached), *performance.runtime_interval(costs, reached))
                ),
            }
        )
    return pd.DataFrame(lines)


def over_scenes(runs: RunSet, values: pd.Series, low: float, high: float) -> tuple[float, float]:
    """Return the interval of the mean of ``values`` by problem: over scenes, and at least that of its searches, ``low`` to ``high``."""
    scenes = runs.scenes[values.index].to_numpy(str)
    half = np.nan_to_num(performance.clustered_error(values.to_numpy(float), scenes))
    return min(low, float(values.mean()) - half), max(high, float(values.mean()) + half)


def share_of_targets(reached: pd.DataFrame) -> tuple[float, float]:
    """Return the mean success rate of a method's lines of :func:`times_to_targets`, and a bound of half its 95% interval.

    The error is due to the seeds. The variance of each rate is that of the estimate of Agresti and Coull (1998), with two more
    successes and two more failures, so that few searches that agree are uncertain. The targets of a problem count as fully
    dependent, the problems as independent.
    """
    p = (reached["successes"] + 2.0) / (reached["searches"] + 4.0)
    by_problem = np.sqrt(p * (1 - p) / reached["searches"]).groupby(reached["problem"]).mean()
    return float(reached["rate"].mean()), performance.Z * float(np.sqrt((by_problem**2).sum()) / len(by_problem))


@remember
def summarise(runs: RunSet) -> pd.DataFrame:
    """Return, per method, the share of targets reached, the score, the profile and the chance to beat the baseline.

    The score is an interquartile mean, its interval a bootstrap. Intervals are over scenes. ``profile`` is the mean over tau in
    [1, 4] of the share of targets reached within tau times the runtime of the best method.
    """
    reached, lines = times_to_targets(runs), []
    slower = reached["art"] / reached.groupby(["problem", "target"])["art"].transform("min")
    profiles = ((4.0 - slower.fillna(math.inf).clip(lower=1.0)) / 3.0).clip(lower=0.0).groupby(reached["method"]).mean()
    better = improvement(runs)
    tied = first_or_tied(runs)
    for method, part in runs.best_runs.groupby("method", sort=False):
        own = reached[reached["method"] == method]
        share, error = share_of_targets(own)
        low, high = over_scenes(runs, own.groupby("problem")["rate"].mean(), share - error, share + error)
        cells = runs.rows[runs.rows["method"] == method]
        lines.append(
            {
                "method": method,
                "problems": part["problem"].nunique(),
                "searches": len(part),
                **ends("reached", (share, max(0.0, low), min(1.0, high))),
                "verdict": "first or tied" if method in tied else "",
                **ends("score", _score(runs, part.dropna(subset="score"))),
                **better.loc[method],
                "profile": profiles[method],
                "diverged": int((part["status"] == "diverged").sum()),
                "tunings": int(cells["tuning"].nunique()),
                "median_score": float(cells["score"].median()),
            }
        )
    return pd.DataFrame(lines)


def improvement(runs: RunSet) -> pd.DataFrame:
    """Return, per method, the probability of a lower final cost than the first method whose estimator is ``fobg``.

    Searches are paired by problem and seed, and problems count the same; a tie counts half. The interval is at least Wilson's,
    which is no single point where few pairs all agree. NaN for the baseline and without pairs.
    """
    final = runs.best_runs.assign(final=runs.best_runs["final_cost"].where(runs.best_runs["status"] == "ok", math.inf))
    wide = final.pivot_table(index=["problem", "seed"], columns="method", values="final", aggfunc="first", dropna=False)
    methods = runs.rows["method"].unique()
    base = next((m for m in methods if m.partition(",")[0].partition("[")[0] == "fobg"), None)
    lines = {}
    for method in methods:
        found = (math.nan, math.nan, math.nan)
        if base not in (None, method) and len(pairs := wide[[method, base]].dropna()):
            wins = (pairs[method] < pairs[base]) + 0.5 * (pairs[method] == pairs[base])
            by_problem = wins.groupby(level="problem").mean()
            share = float(by_problem.mean())
            low, high = over_scenes(runs, by_problem, *performance.wilson(round(share * len(pairs)), len(pairs)))
            found = (share, max(0.0, low), min(1.0, high))
        lines[method] = ends("improvement", found)
    return pd.DataFrame.from_dict(lines, orient="index")


def first_or_tied(runs: RunSet) -> set[str]:
    """Return the methods that reach most targets, or that are not distinguishable from the first, paired by problem.

    Methods that were not run on all problems are not compared.
    """
    reached = times_to_targets(runs)
    rates = reached.pivot_table(index="problem", columns="method", values="rate")
    rates = rates.loc[:, rates.count() == rates.count().max()]
    best = rates.mean().idxmax()
    errors = {method: share_of_targets(reached[reached["method"] == method])[1] for method in rates}
    tied = {str(best)}
    for method in rates:
        lead, error = (rates[best] - rates[method]).dropna(), math.hypot(errors[best], errors[method])
        if over_scenes(runs, lead, lead.mean() - error, lead.mean() + error)[0] < 0.0:
            tied.add(str(method))
    return tied


def _score(runs: RunSet, part: pd.DataFrame) -> tuple[float, float, float]:
    """Return the interquartile mean of the scores with its bootstrap interval: over scenes, or for one over the searches of each problem."""

    def pooled(drawn: Sequence[np.ndarray]) -> float:
        return performance.interquartile_mean(np.concatenate(drawn))

    strata, by_scene = (
        [own.to_numpy() for _, own in part.groupby(names, sort=False)["score"]]
        for names in (part["problem"], part["problem"].map(runs.scenes))
    )
    if not strata:
        return (math.nan,) * 3
    if len(by_scene) < 2:
        return pooled(strata), *performance.bootstrap(strata, pooled)
    places = np.arange(len(by_scene))
    return pooled(strata), *performance.bootstrap([places], lambda drawn: pooled([by_scene[i] for i in drawn[0]]))


def views(experiment: Experiment, rows: pd.DataFrame) -> Views | None:
    """Return the tables and charts of the searches; None without any."""
    runs = collect_runs(experiment, rows)
    if runs.rows.empty:
        return None
    cells = rows.assign(**{c: runs.rows[c] for c in ("problem", "method", "tuning", "best_known", "score")})
    cells = cells.fillna({"problem": "", "method": "", "tuning": ""}).astype({"score": float, "best_known": float})
    by_name = experiment.columns.by_name | {"best_known": Column("best_known", label="J*")}
    return Views(
        tables(experiment, rows, runs),
        charts(runs),
        rows=cells,
        columns=[METHOD, *(by_name[column] for column in PAGE)],
    )


# --------------------------------------------------------------------------------------------------------- tables


def tables(experiment: Experiment, rows: pd.DataFrame, runs: RunSet) -> list[Table]:
    """Return the tables of methods, of times to targets and of lowest costs."""
    reached, summary = times_to_targets(runs), summarise(runs)
    methods = summary.sort_values(["reached", "score"], ascending=False, kind="stable")
    chosen = runs.tuning_seeds
    seeds = f"seeds {', '.join(map(str, chosen))}, which do not score" if chosen else "the same seeds that score"
    return [
        Table(
            "optimise",
            methods,
            [
                METHOD,
                REACHED,
                text("verdict"),
                SCORE,
                interval("improvement", label="beats fobg"),
                Column("profile", log=False),
                *(setting(name) for name in ("tunings", "searches", "diverged")),
                Column("median_score", label="median over tunings", log=False),
            ],
            "methods by the share of targets they reach",
            [NOTE.format(seeds=seeds)],
            terminal=True,
            page=True,
            data=table(experiment, rows),
        ),
        Table(
            "optimise",
            reached.assign(regret=[f"1/{t:g}" for t in reached["target"]]),
            [
                PROBLEM,
                METHOD,
                text("tuning"),
                text("regret"),
                interval("rate", label="searches that reach it"),
                interval(
                    "art",
                    label="average runtime",
                    unit="rollouts",
                    log=True,
                    doc="expected rollouts per target reached: all rollouts of all searches over the searches that reached it",
                ),
            ],
            "Times to targets",
            terminal=True,
        ),
        Table(
            "optimise",
            runs.rows.drop_duplicates("problem"),
            [
                PROBLEM,
                text("scene_class", label="class"),
                Column("start_cost", label="J0", digits=6),
                Column("best_known", label="J*", digits=8),
                text("best_known_status", label="source of J*"),
            ],
            "Lowest costs",
            terminal=True,
        ),
        Table("targets", reached),
        Table("summary", summary),
    ]


# --------------------------------------------------------------------------------------------------------- charts


def charts(runs: RunSet) -> list[Chart]:
    """Return the share of targets that each method reaches, the largest first, and that single searches reach in time.

    Where one parameter of the optimizers is swept, the scores along it stand for the shares.
    """
    problems, times = runs.rows["problem"].unique(), hits(runs)
    where = f"{len(problems)} problems" if len(problems) > 1 else problems[0]
    targets = Chart(
        "targets",
        summarise(runs).sort_values("reached", ascending=False, kind="stable"),
        [REACHED],
        [METHOD],
        "dots",
        series="method",
        title="Which method reaches most targets?",
        subtitle=f"{where}, targets: a tenth, a hundredth and a thousandth of the first regret",
    )
    # the weights of a method's searches add up to 1, in equal parts for its problems and targets
    weight = 1.0 / times.groupby(["problem", "method", "target"])["spent"].transform("size")
    weight = (weight / weight.groupby(times["method"]).transform("sum")).where(times["reached"], 0.0)
    frame = times.assign(share=weight).sort_values("spent", kind="stable")
    starts = frame.drop_duplicates("method").assign(share=0.0, spent=frame["spent"].min())
    frame = pd.concat([starts, frame.assign(share=frame.groupby("method")["share"].cumsum())])
    runtimes = Chart(
        "runtimes",
        frame,
        [Column("spent", label="rollouts", log=True)],
        [Column("share", label="share of targets reached", format="percent", log=False)],
        series="method",
        steps=True,
        title="In how many rollouts does each method reach its targets?",
        subtitle=f"{where}, single searches, a gradient counts as its time in rollouts",
    )
    # two values make no curve
    swept = [axis for axis in runs.tuned if runs.rows[axis.column].nunique() > 2]
    return [_along(runs, swept[0], where) if len(swept) == 1 else targets, runtimes]


def _along(runs: RunSet, axis: Axis, where: str) -> Chart:
    """Return the score of each method along a parameter of the optimizers."""
    groups = runs.rows.dropna(subset="score").groupby(["method", axis.column], sort=False)
    lines = [{"method": name, axis.column: x, **ends("score", _score(runs, part))} for (name, x), part in groups]
    return Chart(
        "tunings",
        pd.DataFrame(lines),
        [setting(axis.column, label=axis.title, log=True)],
        [replace(SCORE, label="share of the way to the lowest cost known", ends=REACHED.ends)],
        series="method",
        subtitle=f"{where} with the same {axis.short}, interquartile mean of searches",
    )
