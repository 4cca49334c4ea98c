"""Aggregates searches by method: regret, times to targets, scores, and the effect of the gradient's error on runtime."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import flatten, swept_columns
from bench.measure import performance
from bench.model.parameters import remember
from bench.report.problems import problem_names, titled
from bench.report.text import axis_value
from bench.report.views import arrange, attempted, estimator_labels

PARTS = ("scene", "contact", "integrator", "backend")
TARGETS = (10.0, 100.0, 1000.0)
"""Target regrets: the first regret divided by each of these factors."""
FEWEST_POINTS = 5
"""Fewest points for a rank correlation."""
MIN_SEEDS_TO_SPLIT = 4
"""Fewest seeds to split: some choose the tunings, the others score."""
ROUNDING = 1e-12
"""Smallest regret, as a share of the first regret: a smaller regret is rounding."""


@dataclass(frozen=True, eq=False)
class RunSet:
    """The searches of an experiment, by problem, method and tuning.

    ``rows`` has the columns ``problem``, ``method``, ``tuning`` (the optimizer's swept parameters as a string),
    ``best_known`` (J*, or the lowest cost of any search if lower), ``best_known_status`` (its source) and ``score``.
    """

    rows: pd.DataFrame
    tuned_axes: tuple[Axis, ...]
    """The swept parameters of optimizers."""

    @property
    def problems(self) -> list[str]:
        """The problems, in order of appearance."""
        return list(dict.fromkeys(self.rows["problem"]))

    @property
    def methods(self) -> list[str]:
        """The methods, in order of appearance."""
        return list(dict.fromkeys(self.rows["method"]))

    @cached_property
    def tuning_seeds(self) -> tuple[int, ...]:
        """The seeds that choose the tunings and do not score: the first third. Empty without tunings or with few seeds."""
        seeds = sorted(int(seed) for seed in self.rows["seed"].unique())
        several = (self.rows.groupby(["problem", "method"])["tuning"].nunique() > 1).any()
        return tuple(seeds[: math.ceil(len(seeds) / 3)]) if several and len(seeds) >= MIN_SEEDS_TO_SPLIT else ()

    @cached_property
    def best_tunings(self) -> dict[tuple[str, str], str]:
        """The tuning with the lowest median final cost, by problem and method.

        The median is over the tuning seeds, or over all seeds if there are no tuning seeds. A failed search counts as
        inf.
        """
        best: dict[tuple[str, str], tuple[float, str]] = {}
        rows = self.rows[self.rows["seed"].isin(self.tuning_seeds)] if self.tuning_seeds else self.rows
        final = rows["final_cost"].where(rows["status"] == "ok", math.inf).fillna(math.inf)
        for key, part in final.groupby([rows[n] for n in ("problem", "method", "tuning")], sort=False):
            problem, method, tuning = (str(k) for k in key)
            # the lower of the two middle costs, because their mean is infinite if one search failed
            middle = float(np.sort(part.to_numpy())[(len(part) - 1) // 2])
            if (problem, method) not in best or middle < best[problem, method][0]:
                best[problem, method] = (middle, tuning)
        return {key: tuning for key, (_, tuning) in best.items()}

    @cached_property
    def best_runs(self) -> pd.DataFrame:
        """The rows of each method's best tuning on each problem, without the tuning seeds."""
        rows = self.rows[~self.rows["seed"].isin(self.tuning_seeds)]
        keys = zip(rows["problem"], rows["method"], rows["tuning"], strict=True)
        return rows[[self.best_tunings.get((problem, method)) == tuning for problem, method, tuning in keys]]

    def by_method(self) -> Iterator[tuple[str, str, pd.DataFrame]]:
        """Yield each problem and method, with the rows of its best tuning."""
        for key, part in self.best_runs.groupby(["problem", "method"], sort=False):
            yield str(key[0]), str(key[1]), part

    def gradient_ratio(self, problem: str, default: float) -> float:
        """Return the rollouts that take as long as one gradient: the median over searches, or ``default`` if untimed."""
        ratios = self.rows.loc[self.rows["problem"] == problem, "gradient_ratio"].dropna()
        return float(ratios.median()) if len(ratios) else default


def collect_runs(experiment: Experiment, rows: pd.DataFrame) -> RunSet:
    """Return the searches that ran, with names of problem, method and tuning, and scores."""
    shown = arrange(experiment, rows)
    runs = attempted(shown.rows)
    runs = runs[np.isfinite(runs["start_cost"])]
    tuned_axes = tuple(axis for axis in shown.axes if _is_tuned(axis, runs))
    names = problem_names(shown, PARTS, tuned_axes, rows=runs).astype(str)
    runs = runs.assign(problem=names, estimator_label=estimator_labels(runs), tuning=_tuning_labels(runs, tuned_axes))
    runs = runs.assign(method=titled(runs, ["estimator_label", "optimizer"]))
    best_known, status = _best_known_cost(runs)
    start, final = runs["start_cost"], runs["final_cost"]
    achievable = (start - best_known).where(start > best_known)
    score = ((start - final) / achievable).clip(0.0, 1.0).mask(runs["status"] != "ok", 0.0)
    return RunSet(runs.assign(best_known=best_known, best_known_status=status, score=score), tuned_axes)


def _is_tuned(axis: Axis, rows: pd.DataFrame) -> bool:
    """Return whether an axis sweeps a parameter of an optimizer."""
    table = flatten(rows)
    return any(
        column.startswith("optimizer.") and bool((mask & table[column].notna()).any())
        for name in axis.names
        for column, mask in swept_columns(name, table).items()
    )


def _tuning_labels(rows: pd.DataFrame, axes: Sequence[Axis]) -> pd.Series:
    labels = [
        ", ".join(
            f"{axis.short}={axis_value(value)}" for axis, value in zip(axes, values, strict=True) if value == value
        )
        for values in rows[[axis.column for axis in axes]].to_numpy(float)
    ]
    return pd.Series(labels, index=rows.index, dtype=object)


def _best_known_cost(rows: pd.DataFrame) -> tuple[pd.Series, pd.Series]:
    """Return, per row, the lowest cost known for its problem, and its source: J*, or a search that reached a lower cost."""
    lowest = rows.groupby("problem")["best_cost"].transform("min")
    known = rows["optimum"]
    below = known.isna() | (lowest < known - 1e-9 * known.abs())
    status = rows["optimum_status"].mask(known.isna(), "lowest cost of any search")
    status = status.mask(below & known.notna(), "lowest cost of any search, below J*: " + rows["optimum_status"])
    return known.mask(below, lowest), status


# -------------------------------------------------------------------------------------------------- single paths


def rollouts_spent(row: pd.Series, ratio: float) -> np.ndarray:
    """Return the rollouts spent up to each stored point of a path, where a gradient counts as ``ratio`` rollouts."""
    return np.asarray(row["path_rollouts"], dtype=float) + ratio * np.asarray(row["path_gradients"], dtype=float)


def regret(row: pd.Series) -> np.ndarray:
    """Return the regret J(theta_t) - J* at each stored point of a path, at least :data:`ROUNDING` of the first regret."""
    cost = np.asarray(row["path_cost"], dtype=float)
    rounding = ROUNDING * max(abs(row["start_cost"] - row["best_known"]), 1e-300)
    return np.asarray(np.maximum(cost - row["best_known"], rounding))


def regret_quantiles(rows: pd.DataFrame, spent: Sequence[np.ndarray], grid: np.ndarray) -> np.ndarray:
    """Return the 20%, 50% and 80% quantiles of regret over paths at each budget of ``grid``: ``(3, len(grid))``.

    ``spent`` has the budget spent up to each point of each path. After its end, a path has its last regret, or infinite
    regret if it diverged.
    """
    lines = []
    for places, (_, row) in zip(spent, rows.iterrows(), strict=True):
        values = np.append(regret(row), math.inf if row["status"] == "diverged" else regret(row)[-1])
        ends = np.append(places, places[-1] * (1 + 1e-9) + 1e-12)
        lines.append(values[np.maximum(np.searchsorted(ends, grid, side="right") - 1, 0)])
    return np.quantile(np.where(np.isnan(lines), math.inf, lines), [0.2, 0.5, 0.8], axis=0, method="nearest")


def hitting_times(rows: pd.DataFrame, factor: float, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the rollouts until each path's regret is at most its first regret / ``factor``, and whether it reaches that.

    A path that never reaches the target has the number of all its rollouts. A gradient counts as ``ratio`` rollouts.
    """
    rollouts, reached = [], []
    for _, row in rows.iterrows():
        spent = rollouts_spent(row, ratio)
        below = np.flatnonzero(regret(row) <= regret(row)[0] / factor)
        rollouts.append(float(spent[below[0] if below.size else -1]))
        reached.append(bool(below.size))
    return np.array(rollouts), np.array(reached)


# ------------------------------------------------------------------------------------------------------- tables


@remember
def times_to_targets(runs: RunSet, default: float) -> pd.DataFrame:
    """Return, per problem, method and target, successes with Wilson's interval and the average runtime in rollouts.

    ``default``, here and below, is the number of rollouts that a gradient counts as if no times were measured.
    """
    lines = []
    for problem, method, part in runs.by_method():
        ratio = runs.gradient_ratio(problem, default)
        for factor in TARGETS:
            costs, reached = hitting_times(part, factor, ratio)
            low, high = performance.wilson(int(reached.sum()), len(reached))
            art_low, art_high = performance.runtime_interval(costs, reached)
            lines.append({
                "problem": problem, "method": method, "tuning": runs.best_tunings[problem, method], "target": factor,
                "successes": int(reached.sum()), "searches": len(reached), "rate": float(reached.mean()),
                "rate_low": low, "rate_high": high, "art": performance.average_runtime(costs, reached),
                "art_low": art_low, "art_high": art_high,
            })  # fmt: skip
    return pd.DataFrame(lines)


def runtimes(runs: RunSet, default: float) -> pd.DataFrame:
    """Return the rollouts of each search until each target, infinite if it is missed, and the weight of the search.

    The weights of a method add up to 1, in equal parts for its problems and targets.
    """
    lines = []
    for problem, method, part in runs.by_method():
        for factor in TARGETS:
            spent, reached = hitting_times(part, factor, runs.gradient_ratio(problem, default))
            lines += [(method, 1.0 / len(spent), cost) for cost in np.where(reached, spent, math.inf)]
    table = pd.DataFrame(lines, columns=["method", "weight", "runtime"])
    return table.assign(weight=table["weight"] / table.groupby("method")["weight"].transform("sum"))


def share_of_targets(reached: pd.DataFrame) -> tuple[float, float]:
    """Return the mean success rate of a method's lines of :func:`times_to_targets`, and a bound of its standard error.

    The error is due to the seeds. The variance of each rate is that of the estimate of Agresti and Coull (1998), with two more
    successes and two more failures, so that few searches that agree are uncertain. The targets of a problem count as fully
    dependent, the problems as independent.
    """
    p = (reached["successes"] + 2.0) / (reached["searches"] + 4.0)
    by_problem = np.sqrt(p * (1 - p) / reached["searches"]).groupby(reached["problem"]).mean()
    return float(reached["rate"].mean()), float(np.sqrt((by_problem**2).sum()) / len(by_problem))


@remember
def summarise(runs: RunSet, default: float, baseline: str = "fobg") -> pd.DataFrame:
    """Return, per method, the share of targets reached, the score, the chance to beat the baseline, and the profile.

    The score is an interquartile mean, its interval a bootstrap stratified by problem. ``improvement``, with Wilson's interval, is the
    probability of a lower final cost than the first method whose estimator is ``baseline``, paired by problem and seed.
    """
    reached = times_to_targets(runs, default)
    fastest = reached.groupby(["problem", "target"])["art"].transform("min") if len(reached) else None
    base = next((m for m in runs.methods if m.partition(",")[0].partition("[")[0] == baseline), None)
    lines = []
    for method, part in runs.best_runs.groupby("method", sort=False):
        strata = [scores["score"].dropna().to_numpy() for _, scores in part.groupby("problem", sort=False)]
        strata = [scores for scores in strata if len(scores)]
        low, high = performance.bootstrap(strata, _pooled_score) if strata else (math.nan, math.nan)
        better, better_low, better_high = _improvement(runs, str(method), base)
        own = reached[reached["method"] == method]
        times, (share, error) = own["art"], share_of_targets(own)
        assert fastest is not None
        ratios = (times / fastest[times.index]).to_numpy()
        cells = runs.rows[runs.rows["method"] == method]
        lines.append({
            "method": method, "problems": part["problem"].nunique(), "searches": len(part),
            "reached": share, "reached_low": max(0.0, share - performance.Z * error),
            "reached_high": min(1.0, share + performance.Z * error), "reached_se": error,
            "score": _pooled_score(strata), "score_low": low, "score_high": high,
            "improvement": better, "improvement_low": better_low, "improvement_high": better_high,
            "profile": performance.profile_score(ratios), "diverged": int((part["status"] == "diverged").sum()),
            "tunings": int(cells["tuning"].nunique()), "median_score": float(cells["score"].median()),
        })  # fmt: skip
    return pd.DataFrame(lines)


def _pooled_score(strata: Sequence[np.ndarray]) -> float:
    return performance.interquartile_mean(np.concatenate(strata)) if strata else math.nan


def _improvement(runs: RunSet, method: str, base: str | None) -> tuple[float, float, float]:
    """Return the probability that a method's final cost is below the baseline's, with its interval; NaN without pairs."""
    if base is None or method == base:
        return math.nan, math.nan, math.nan
    final = runs.best_runs
    final = final.assign(final=final["final_cost"].where(final["status"] == "ok", math.inf))
    wide = final.pivot_table(index=["problem", "seed"], columns="method", values="final", aggfunc="first", dropna=False)
    both = wide[[method, base]].dropna()
    strata = [part.to_numpy() for _, part in both.groupby(level="problem")]
    if not strata:
        return math.nan, math.nan, math.nan
    share = float(np.mean([performance.improvement(part[:, 0], part[:, 1]) for part in strata]))
    # if few pairs all agree, a bootstrap interval would be a single point; Wilson's is not
    return share, *performance.wilson(round(share * len(both)), len(both))


@remember
def quality_and_runtime(runs: RunSet, default: float, factor: float = TARGETS[0]) -> pd.DataFrame:
    """Return, per problem and method with an estimator, the gradient's quality at the start and the runtime to a target.

    ``art`` is the average runtime, in rollouts, until the regret is the first regret / ``factor``.
    """
    lines = []
    for problem, method, part in runs.by_method():
        first = part.iloc[0]
        if not math.isfinite(first["quality_rmse_rel"]):
            continue
        costs, reached = hitting_times(part, factor, runs.gradient_ratio(problem, default))
        lines.append({
            "problem": problem, "method": method, "estimator": method.partition(",")[0], "scene_class": first["scene_class"],
            "rmse_rel": float(part["quality_rmse_rel"].median()), "cosine": float(part["quality_cosine"].median()),
            "bias_share": float(part["quality_bias_share"].median()), "sigma": first["sigma"],
            "art": performance.average_runtime(costs, reached), "most": float(costs.max()),
        })  # fmt: skip
    return pd.DataFrame(lines)


@remember
def effects_of_error(runs: RunSet, default: float) -> pd.DataFrame:
    """Return :func:`rank_correlations` of the errors and runtimes of :func:`quality_and_runtime`, with a verdict.

    Gradients with smaller errors reach the target ``sooner`` or ``later`` where the whole interval is on one side of 0, and
    a random order is seldom as good; else it is ``open``.
    """
    rho = rank_correlations(quality_and_runtime(runs, default))
    is_known = (rho["points"] >= FEWEST_POINTS) & (rho["chance"] <= CHANCE)
    sides = {"sooner": is_known & (rho["rho_low"] > 0), "later": is_known & (rho["rho_high"] < 0)}
    return rho.assign(verdict=np.select(list(sides.values()), list(sides), "open"))


CHANCE = 0.05
"""An order counts as random if a random order is at least as good with more than this probability."""


def is_tied(summary: pd.DataFrame) -> pd.Series:
    """Return a mask of the methods that reach most targets, or that are not distinguishable from the first.

    Methods that were not run on all problems are not compared.
    """
    full = summary[summary["problems"] == summary["problems"].max()]
    best = full.loc[full["reached"].idxmax()]
    error = np.sqrt(best["reached_se"] ** 2 + full["reached_se"] ** 2)
    tied = (best["reached"] - full["reached"] < performance.Z * error) | (full.index == best.name)
    return tied.reindex(summary.index, fill_value=False)


def rank_correlations(points: pd.DataFrame) -> pd.DataFrame:
    """Return Spearman's rho of gradient error against runtime, by class of scene.

    Costs vary between problems, so errors and runtimes are ranked within each problem, and the ranks are scaled to
    0..1. A positive rho means that gradients with smaller errors reach the target sooner. It is NaN from fewer than
    :data:`FEWEST_POINTS` points.
    """
    lines = []
    if points.empty:
        return pd.DataFrame(columns=["scene_class", "rho", "rho_low", "rho_high", "chance", "points", "problems"])
    for name, part in points.groupby("scene_class", sort=False):
        strata = []
        for _, methods in part.groupby("problem", sort=False):
            if len(methods) > 1:
                ranks = [performance.ranks(methods[column].to_numpy()) for column in ("rmse_rel", "art")]
                strata.append((np.stack(ranks, axis=1) - 1) / (len(methods) - 1))
        pooled = np.concatenate(strata) if strata else np.empty((0, 2))
        enough = len(pooled) >= FEWEST_POINTS
        low, high = performance.spearman_interval(strata) if enough else (math.nan, math.nan)
        lines.append({
            "scene_class": str(name), "rho": performance.spearman(pooled[:, 0], pooled[:, 1]) if enough else math.nan,
            "rho_low": low, "rho_high": high, "chance": performance.spearman_chance(strata) if enough else 1.0,
            "points": len(pooled), "problems": len(strata),
        })  # fmt: skip
    return pd.DataFrame(lines)


def path_quality(runs: RunSet) -> pd.DataFrame:
    """Return the median, 20% and 80% quantile over seeds of the gradient's relative error and cosine along the path.

    There is one line per problem, method and point of the path, and none if quality was measured only at the start.
    """
    parts = []
    for problem, method, part in runs.by_method():
        counts = part["path_quality_iteration"].map(lambda places: len(_as_list(places)))
        if not counts.max() > 1:
            continue
        whole = part[counts == counts.max()]
        line: dict[str, Any] = {"problem": problem, "method": method}
        line["iteration"] = np.median(np.stack(whole["path_quality_iteration"]), axis=0)
        for prefix, quantity in (("", "rmse_rel"), ("cosine_", "cosine")):
            ends = np.quantile(np.stack(whole[f"path_quality_{quantity}"]), [0.2, 0.5, 0.8], axis=0)
            line |= dict(zip((f"{prefix}low", f"{prefix}value", f"{prefix}high"), ends, strict=True))
        parts.append(pd.DataFrame(line))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def _as_list(value: object) -> list[float]:
    return list(value) if isinstance(value, list | tuple | np.ndarray) else []


def scores_by_tuning(runs: RunSet) -> pd.DataFrame:
    """Return the median score and its 20% to 80% range by problem, method and value of each tuned parameter."""
    lines = []
    for axis in runs.tuned_axes:
        known = runs.rows[np.isfinite(runs.rows[axis.column].astype(float))]
        for key, part in known.groupby(["problem", "method", axis.column], sort=False):
            low, middle, high = part["score"].fillna(0.0).quantile([0.2, 0.5, 0.8])
            lines.append({
                "axis": axis.column, "problem": key[0], "method": key[1], "value": float(key[2]),
                "score": middle, "low": low, "high": high, "searches": len(part),
            })  # fmt: skip
    return pd.DataFrame(lines, columns=["axis", "problem", "method", "value", "score", "low", "high", "searches"])
