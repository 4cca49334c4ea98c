"""What searches say about methods: regrets, times to targets, scores, and whether a better gradient was worth it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import flatten, swept_columns
from bench.measure import performance
from bench.model.parameters import remember
from bench.report.text import axis_value
from bench.report.views import Arranged, arranged, attempted
from bench.report.web.content import problems

PARTS = ("scene", "contact", "integrator", "backend")
TARGETS = (10.0, 100.0, 1000.0)
"""A target is the first regret divided by one of these."""
RESTARTS = 100
"""Simulated runs with restarts per problem and target."""
FEWEST_SEEDS = 4
"""Seeds from which some only choose tunings and the others only score: fewer are too few to be parted."""
ROUNDING = 1e-12
"""Regret below this share of the first one is 0."""


@dataclass(frozen=True, eq=False)
class RunSet:
    """The searches of an experiment, by problem, method and tuning.

    ``rows`` has the columns ``problem``, ``method``, ``tuning`` (text of the optimizer's swept parameters), ``least`` (J*,
    or the lowest cost of any row where that is lower), ``least_status`` and ``score`` against it.
    """

    rows: pd.DataFrame
    tuned: tuple[Axis, ...]
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
        """The first third of the seeds, which choose tunings and score nothing; none where nothing is tuned or seeds are few."""
        seeds = sorted(int(seed) for seed in self.rows["seed"].unique())
        several = (self.rows.groupby(["problem", "method"])["tuning"].nunique() > 1).any()
        return tuple(seeds[: math.ceil(len(seeds) / 3)]) if several and len(seeds) >= FEWEST_SEEDS else ()

    @cached_property
    def chosen(self) -> dict[tuple[str, str], str]:
        """The tuning of each problem and method with the best median final cost over the tuning seeds, or all seeds where
        there are none; a lost search counts as inf."""
        best: dict[tuple[str, str], tuple[float, str]] = {}
        rows = self.rows[self.rows["seed"].isin(self.tuning_seeds)] if self.tuning_seeds else self.rows
        final = rows["final_cost"].where(rows["status"] == "ok", math.inf).fillna(math.inf)
        for key, part in final.groupby([rows[n] for n in ("problem", "method", "tuning")], sort=False):
            problem, method, tuning = (str(k) for k in key)
            # the lower of the two middle ones: a mean with a lost search would be infinite
            middle = float(np.sort(part.to_numpy())[(len(part) - 1) // 2])
            if (problem, method) not in best or middle < best[problem, method][0]:
                best[problem, method] = (middle, tuning)
        return {key: tuning for key, (_, tuning) in best.items()}

    @cached_property
    def best(self) -> pd.DataFrame:
        """The rows of each method's best tuning on each problem, of the seeds that did not choose it."""
        rows = self.rows[~self.rows["seed"].isin(self.tuning_seeds)]
        keys = zip(rows["problem"], rows["method"], rows["tuning"], strict=True)
        return rows[[self.chosen.get((problem, method)) == tuning for problem, method, tuning in keys]]

    def each(self, rows: pd.DataFrame | None = None) -> Iterator[tuple[str, str, pd.DataFrame]]:
        """Yield problem, method and rows of the best tuning, or of the rows given."""
        for key, part in (self.best if rows is None else rows).groupby(["problem", "method"], sort=False):
            yield str(key[0]), str(key[1]), part


_made: dict[tuple[int, int], tuple[Experiment, pd.DataFrame, RunSet]] = {}
"""The races arranged last, by identity of experiment and rows, which are kept so that no other gets their place."""


def races(experiment: Experiment, rows: pd.DataFrame) -> RunSet:
    """Arrange the rows of searches; refused ones are left out."""
    key = (id(experiment), id(rows))
    if key not in _made:
        _made.clear()
        _made[key] = (experiment, rows, _races(experiment, rows))
    return _made[key][2]


def _races(experiment: Experiment, rows: pd.DataFrame) -> RunSet:
    shown = arranged(experiment, rows)
    kept = attempted(shown.rows)
    kept = kept[np.isfinite(kept["start_cost"])]
    tuned = tuple(axis for axis in shown.axes if _tunes(axis, kept))
    kept = kept.assign(problem=_named(shown, kept, tuned), method=_methods(kept), tuning=_tunings(kept, tuned))
    least, status = _least(kept)
    start, final = kept["start_cost"], kept["final_cost"]
    way = (start - least).where(start > least)
    score = ((start - final) / way).clip(0.0, 1.0).mask(kept["status"] != "ok", 0.0)
    return RunSet(kept.assign(least=least, least_status=status, score=score), tuned)


def _tunes(axis: Axis, rows: pd.DataFrame) -> bool:
    table = flatten(rows)
    return any(
        column.startswith("optimizer.") and bool((mask & table[column].notna()).any())
        for name in axis.names
        for column, mask in swept_columns(name, table).items()
    )


def _named(shown: Arranged, rows: pd.DataFrame, tuned: Sequence[Axis]) -> pd.Series:
    return problems(shown, PARTS, tuned, rows=rows).astype(str)


def _methods(rows: pd.DataFrame) -> pd.Series:
    """Name estimator and optimizer: ``fobg, adam``; the optimizer alone where there is no estimator."""
    names = []
    for estimator, params, optimizer in rows[["estimator", "estimator_params", "optimizer"]].to_numpy():
        named = f"{estimator}[{params}]" if params else estimator
        names.append(", ".join(filter(None, (named, optimizer))))
    return pd.Series(names, index=rows.index, dtype=object)


def _tunings(rows: pd.DataFrame, tuned: Sequence[Axis]) -> pd.Series:
    lines = [
        ", ".join(
            f"{axis.short}={axis_value(value)}" for axis, value in zip(tuned, values, strict=True) if value == value
        )
        for values in rows[[axis.column for axis in tuned]].to_numpy(float)
    ]
    return pd.Series(lines, index=rows.index, dtype=object)


def _least(rows: pd.DataFrame) -> tuple[pd.Series, pd.Series]:
    """Return, per row, the least cost known for its problem, and how: a search may go below a J* of another limit."""
    lowest = rows.groupby("problem")["best_cost"].transform("min")
    known = rows["optimum"]
    below = known.isna() | (lowest < known - 1e-9 * known.abs())
    status = rows["optimum_status"].mask(known.isna(), "lowest cost of any search")
    status = status.mask(below & known.notna(), "lowest cost of any search, below J*: " + rows["optimum_status"])
    return known.mask(below, lowest), status


# -------------------------------------------------------------------------------------------------- single paths


def ratio_of(rows: pd.DataFrame, default: float) -> float:
    """Return the rollouts that a gradient takes the time of, the median over rows; ``default`` without times."""
    known = rows["gradient_ratio"].dropna()
    return float(known.median()) if len(known) else default


def spent(row: pd.Series, ratio: float) -> np.ndarray:
    """Return the rollouts spent at each kept point of a path, a gradient counting as ``ratio``."""
    return np.asarray(row["path_rollouts"], dtype=float) + ratio * np.asarray(row["path_gradients"], dtype=float)


def regret(row: pd.Series) -> np.ndarray:
    """Return J(theta_t) - J* at each kept point of a path, at least rounding."""
    cost = np.asarray(row["path_cost"], dtype=float)
    return np.maximum(cost - row["least"], ROUNDING * max(abs(row["start_cost"] - row["least"]), 1e-300))


def curve(rows: pd.DataFrame, at: Sequence[np.ndarray], grid: np.ndarray) -> np.ndarray:
    """Return the 20%, 50% and 80% quantiles of regret over paths at each place of ``grid``: ``(3, len(grid))``.

    A path stays at its last point; a diverged one is infinite from there on.
    """
    lines = []
    for place, (_, row) in zip(at, rows.iterrows(), strict=True):
        values = np.append(regret(row), math.inf if row["status"] == "diverged" else regret(row)[-1])
        ends = np.append(place, place[-1] * (1 + 1e-9) + 1e-12)
        lines.append(values[np.maximum(np.searchsorted(ends, grid, side="right") - 1, 0)])
    return np.quantile(np.where(np.isnan(lines), math.inf, lines), [0.2, 0.5, 0.8], axis=0, method="nearest")


def arrival(row: pd.Series, factor: float, cost: np.ndarray) -> tuple[float, bool]:
    """Return the cost at which a path first had at most the first regret over ``factor``, and whether it ever had."""
    below = np.flatnonzero(regret(row) <= regret(row)[0] / factor)
    return (float(cost[below[0]]), True) if below.size else (float(cost[-1]), False)


# ------------------------------------------------------------------------------------------------------- tables


@remember
def targets(found: RunSet, default: float) -> pd.DataFrame:
    """Return, per problem, method and target, successes with Wilson's interval and the average runtime in rollouts."""
    lines = []
    for problem, method, part in found.each():
        ratio = ratio_of(found.rows[found.rows["problem"] == problem], default)
        for factor in TARGETS:
            pairs = np.array([arrival(row, factor, spent(row, ratio)) for _, row in part.iterrows()])
            reached, costs = pairs[:, 1].astype(bool), pairs[:, 0]
            low, high = performance.wilson(int(reached.sum()), len(reached))
            art_low, art_high = performance.runtime_interval(costs, reached)
            lines.append({
                "problem": problem, "method": method, "tuning": found.chosen[problem, method], "target": factor,
                "successes": int(reached.sum()), "searches": len(reached), "rate": float(reached.mean()),
                "rate_low": low, "rate_high": high, "art": performance.average_runtime(costs, reached),
                "art_low": art_low, "art_high": art_high,
            })  # fmt: skip
    return pd.DataFrame(lines)


def runtimes(found: RunSet, default: float) -> dict[str, np.ndarray]:
    """Return, per method, runtimes with simulated restarts over all problems and targets."""
    times: dict[str, list[np.ndarray]] = {method: [] for method in found.methods}
    for problem, method, part in found.each():
        ratio = ratio_of(found.rows[found.rows["problem"] == problem], default)
        for seed, factor in enumerate(TARGETS):
            pairs = np.array([arrival(row, factor, spent(row, ratio)) for _, row in part.iterrows()])
            times[method].append(performance.runtimes(pairs[:, 0], pairs[:, 1].astype(bool), RESTARTS, seed))
    return {method: np.concatenate(parts) for method, parts in times.items() if parts}


@remember
def summary(found: RunSet, default: float, baseline: str = "fobg") -> pd.DataFrame:
    """Return, per method, the interquartile mean score, its chance to beat the baseline, and its share of best times.

    The score's interval is a bootstrap stratified by problem, that of ``improvement`` Wilson's. ``improvement`` compares final costs with those of the first method
    whose estimator is ``baseline``, paired by problem and seed.
    """
    reached = targets(found, default)
    fastest = reached.groupby(["problem", "target"])["art"].transform("min") if len(reached) else None
    base = next((m for m in found.methods if m.partition(",")[0].partition("[")[0] == baseline), None)
    lines = []
    for method, part in found.best.groupby("method", sort=False):
        strata = [one["score"].dropna().to_numpy() for _, one in part.groupby("problem", sort=False)]
        strata = [one for one in strata if len(one)]
        low, high = performance.bootstrap(strata, _pooled) if strata else (math.nan, math.nan)
        better, better_low, better_high = _improvement(found, str(method), base)
        own = reached[reached["method"] == method]
        assert fastest is not None
        ratios = (own["art"] / fastest[own.index]).to_numpy()
        cells = found.rows[found.rows["method"] == method]
        lines.append({
            "method": method, "problems": part["problem"].nunique(), "searches": len(part),
            "score": _pooled(strata) if strata else math.nan, "score_low": low, "score_high": high,
            "improvement": better, "improvement_low": better_low, "improvement_high": better_high,
            "profile": performance.profile_score(ratios), "diverged": int((part["status"] == "diverged").sum()),
            "tunings": int(cells["tuning"].nunique()), "median_score": float(cells["score"].median()),
        })  # fmt: skip
    return pd.DataFrame(lines)


def _pooled(strata: Sequence[np.ndarray]) -> float:
    return performance.interquartile_mean(np.concatenate(strata)) if strata else math.nan


def _improvement(found: RunSet, method: str, base: str | None) -> tuple[float, float, float]:
    if base is None or method == base:
        return math.nan, math.nan, math.nan
    final = found.best.assign(final=found.best["final_cost"].where(found.best["status"] == "ok", math.inf))
    wide = final.pivot_table(index=["problem", "seed"], columns="method", values="final", aggfunc="first", dropna=False)
    both = wide[[method, base]].dropna()
    strata = [part.to_numpy() for _, part in both.groupby(level="problem")]
    if not strata:
        return math.nan, math.nan, math.nan

    share = float(np.mean([performance.improvement(part[:, 0], part[:, 1]) for part in strata]))
    # of few pairs all may agree, and every resample with them: Wilson's interval of the pairs stays wide
    return share, *performance.wilson(round(share * len(both)), len(both))


@remember
def quality(found: RunSet, default: float, factor: float = TARGETS[0]) -> pd.DataFrame:
    """Return, per problem and method with an estimator: its gradient's quality at the start, and the runtime to a target."""
    lines = []
    for problem, method, part in found.each():
        first = part.iloc[0]
        if not math.isfinite(first["quality_rmse_rel"]):
            continue
        ratio = ratio_of(found.rows[found.rows["problem"] == problem], default)
        pairs = np.array([arrival(row, factor, spent(row, ratio)) for _, row in part.iterrows()])
        lines.append({
            "problem": problem, "method": method, "estimator": method.partition(",")[0], "scene_class": first["scene_class"],
            "rmse_rel": float(part["quality_rmse_rel"].median()), "cosine": float(part["quality_cosine"].median()),
            "bias_share": float(part["quality_bias_share"].median()), "sigma": first["sigma"],
            "art": performance.average_runtime(pairs[:, 0], pairs[:, 1].astype(bool)), "most": float(pairs[:, 0].max()),
        })  # fmt: skip
    return pd.DataFrame(lines)


def correlations(points: pd.DataFrame) -> pd.DataFrame:
    """Return Spearman's rho of gradient error against runtime by class of scene, runtimes ranked within their problem.

    Problems differ in cost by themselves, so errors and runtimes are compared among the methods of one problem only: each
    is replaced by its rank there, scaled to 0..1. A positive rho says that the smaller error arrives sooner.
    """
    lines = []
    if points.empty:
        return pd.DataFrame(columns=["scene_class", "rho", "rho_low", "rho_high", "chance", "points", "problems"])
    for name, part in itertools.chain([("all", points)], points.groupby("scene_class", sort=False)):
        strata = []
        for _, one in part.groupby("problem", sort=False):
            if len(one) > 1:
                both = np.stack(
                    [performance.ranks(one["rmse_rel"].to_numpy()), performance.ranks(one["art"].to_numpy())], axis=1
                )
                strata.append((both - 1) / (len(one) - 1))
        pooled = np.concatenate(strata) if strata else np.empty((0, 2))
        low, high = performance.spearman_interval(strata) if len(pooled) > 2 else (math.nan, math.nan)
        lines.append({
            "scene_class": str(name), "rho": performance.spearman(pooled[:, 0], pooled[:, 1]), "rho_low": low,
            "rho_high": high, "chance": performance.spearman_chance(strata) if len(pooled) > 2 else 1.0,
                "points": len(pooled), "problems": len(strata),
        })  # fmt: skip
    return pd.DataFrame(lines)


def path_quality(found: RunSet) -> pd.DataFrame:
    """Return median, 20% and 80% quantile over seeds of the gradient's relative error and cosine, by place on the path.

    A row for each problem, method, quantity and place; empty where quality was measured at the start alone.
    """
    lines = []
    for problem, method, part in found.each():
        paths = [row for _, row in part.iterrows() if len(_listed(row["path_quality_iteration"])) > 1]
        places = max((len(_listed(row["path_quality_iteration"])) for row in paths), default=0)
        whole = [row for row in paths if len(_listed(row["path_quality_iteration"])) == places]
        for quantity in ("rmse_rel", "cosine") if whole else ():
            values = np.array([_listed(row[f"path_quality_{quantity}"]) for row in whole], dtype=float)
            moments = np.median(
                np.array([_listed(row["path_quality_iteration"]) for row in whole], dtype=float), axis=0
            )
            low, middle, high = np.quantile(values, [0.2, 0.5, 0.8], axis=0)
            lines += [
                {
                    "problem": problem,
                    "method": method,
                    "quantity": quantity,
                    "iteration": i,
                    "value": m,
                    "low": a,
                    "high": b,
                }
                for i, m, a, b in zip(moments, middle, low, high, strict=True)
            ]
    return pd.DataFrame(lines, columns=["problem", "method", "quantity", "iteration", "value", "low", "high"])


def _listed(value: object) -> list[float]:
    return list(value) if isinstance(value, list | tuple | np.ndarray) else []


def rates(found: RunSet) -> pd.DataFrame:
    """Return median score and its 20% to 80% range by problem, method and value of each tuned axis."""
    lines = []
    for axis in found.tuned:
        known = found.rows[np.isfinite(found.rows[axis.column].astype(float))]
        for key, part in known.groupby(["problem", "method", axis.column], sort=False):
            low, middle, high = part["score"].fillna(0.0).quantile([0.2, 0.5, 0.8])
            lines.append({
                "axis": axis.column, "problem": key[0], "method": key[1], "value": float(key[2]),
                "score": middle, "low": low, "high": high, "searches": len(part),
            })  # fmt: skip
    return pd.DataFrame(lines, columns=["axis", "problem", "method", "value", "score", "low", "high", "searches"])
