"""Analyses the searches by class and target: exclusions, fits, costs, controls, and a second analysis."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import bdtr, stdtrit

from bench.measure.performance import wilson
from bench.report.text import axis_value
from bench.studies.dose_response.model import (
    Data,
    Estimate,
    Fit,
    Scatter,
    bootstrap,
    estimate,
    fit,
    left_out_likelihoods,
)
from bench.studies.dose_response.search import TARGETS

CLASSES = ("smooth", "stiff", "discontinuous", "chaotic", "identification")
"""The classes of problems, in the order in which they are shown."""
MAIN = 100.0
"""The target of the main chart."""
SHOWN = (10.0, 100.0, 1000.0)
LEAST_UPDATES = 5
"""Fewest updates of the best gradient at which a problem counts for a target."""
LEAST_PROBLEMS = 4
"""Fewest problems of a class at which its fits count."""
DRAWS = 100
"""Bootstrap samples of a fit."""
RATIOS = (1.0, 2.0, 4.0)
"""Rollouts that a gradient is charged as, beside the measured number."""
BEST, RANDOM, FIXED, TAILS, BIAS, ROTATION = (
    "best gradient", "random error", "random error of fixed size", "heavy-tailed error", "bias", "rotation",
)  # fmt: skip
PLANTED = (RANDOM, FIXED, TAILS, BIAS, ROTATION)
DOSES = {"noise": RANDOM, "bias": BIAS, "angle": ROTATION}
"""Parameters of an estimator with a planted error, and the kind of error."""
PREDICTORS = ("error", "bias", "spread", "cosine", "sign_agreement")


def searches(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per problem, method and target, with the updates of its runs, infinite where they were missed.

    Columns: problem, scene_class, kind, method, dose, target, times (list), median, budget, and the row's measurements.
    Methods that use costs only have kind ``costs only``. Copies of the best gradient with fewer samples are left out.
    """
    good = rows[rows["status"] == "ok"]
    lines = []
    for index, row in good.iterrows():
        kind, dose = _kind(row)
        times = np.asarray(row["updates"], dtype=float).reshape(len(TARGETS), -1)
        rates = np.asarray(row["rate_updates"], dtype=float).reshape(-1, len(TARGETS))
        for k, target in enumerate(TARGETS):
            values = np.where(np.isnan(times[k]), np.inf, times[k])
            by_rate = np.where(np.isnan(rates[:, k]), np.inf, rates[:, k])
            lines.append({
                "row": index, "problem": problem_name(row), "scene_class": row["scene_class"], "kind": kind,
                "method": _method(row, kind), "dose": dose, "target": target, "times": values, "median": float(np.median(values)),
                "budget": row["budget"], "runs": row["runs"], "samples": row["samples"], "by_rate": by_rate,
                "best_rate": row["best_rates"][k], "rates": np.asarray(row["rates"], dtype=float),
                "inside": bool(row["is_inside"][k]), "median_over_rates": float(np.median(by_rate)),
                **{name: row[name] for name in (*PREDICTORS, "rollouts_per_update", "gradients_per_update", "rollout_s",
                                                "gradient_s", "tuning_rollouts", "tuning_gradients", "lowest")},
            })  # fmt: skip
    table = pd.DataFrame(lines)
    if table.empty:
        return table
    # times belong to the problem, and only some of its cells may have been timed
    for name in ("rollout_s", "gradient_s"):
        table[name] = table.groupby("problem")[name].transform("median")
    table["place"] = table["scene_class"].map({name: i for i, name in enumerate(CLASSES)})
    table = table.sort_values("place", kind="stable", ignore_index=True)
    most = table[table["kind"] == BEST].groupby("problem")["samples"].transform("max")
    copies = table["kind"].eq(BEST) & table["samples"].ne(most.reindex(table.index))
    return table[~copies].reset_index(drop=True)


def problem_name(row: Any) -> str:
    """Return a problem's name: scene with horizon and step, and contact law with stiffness."""
    parts = [str(row["scene"])]
    if row["horizon"] > 0:
        parts.append(f"T={axis_value(row['horizon'])}")
    if math.isfinite(row["dt"]) and row["dt"] > 0:
        parts.append(f"dt={axis_value(row['dt'])}")
    if row["contact"] not in ("none", ""):
        stiff = f" k={axis_value(row['stiffness'])}" if math.isfinite(row["stiffness"]) else ""
        parts.append(f"{row['contact']}{stiff}")
    elif math.isfinite(row["stiffness"]):
        parts.append(f"k={axis_value(row['stiffness'])}")
    return ", ".join(parts)


def _kind(row: Any) -> tuple[str, float]:
    """Return the kind of error that the estimator plants and its size; or its label and NaN."""
    parameters = json.loads(row["parameters"])
    estimator = parameters.get("estimator")
    if not estimator:
        return "costs only", math.nan
    given = estimator.get("parameters", estimator)
    if not {*DOSES, "base", "scale", "tails"} <= set(given):
        return ("first order" if row["rollouts_per_update"] == 0 else
                "zeroth order" if row["gradients_per_update"] == 0 else "both orders"), math.nan  # fmt: skip
    for name, kind in DOSES.items():
        if given[name]:
            if kind == RANDOM and given["tails"]:
                kind = TAILS
            elif kind == RANDOM and given["scale"] == "start":
                kind = FIXED
            return kind, float(given[name])
    return BEST, 0.0


def _method(row: Any, kind: str) -> str:
    if kind == "costs only":
        return str(row["optimizer"])
    if kind in (*PLANTED, BEST):
        return kind
    return f"{row['estimator']}[{row['estimator_params']}]" if row["estimator_params"] else str(row["estimator"])


# ---------------------------------------------------------------------------------------------------- exclusions


def floors(table: pd.DataFrame) -> pd.DataFrame:
    """Return the best gradient's median updates per problem and target, and why the problem does not count, if so."""
    best = table[table["kind"] == BEST][["problem", "scene_class", "target", "median", "budget", "error"]]
    reasons = [
        "" if math.isfinite(m) and m >= LEAST_UPDATES else
        f"the best gradient needs {m:g} updates" if math.isfinite(m) else "the best gradient misses the target"
        for m in best["median"]
    ]  # fmt: skip
    return best.rename(columns={"median": "floor"}).assign(reason=reasons)


def counted(table: pd.DataFrame) -> pd.DataFrame:
    """Return the lines that count: of eligible problems and known errors, with the best gradient's updates as ``floor``."""
    known = floors(table)
    eligible = known[known["reason"] == ""][["problem", "target", "floor"]]
    merged = table.merge(eligible, on=["problem", "target"])
    return merged[merged["error"].notna() & (merged["kind"] != "costs only")].reset_index(drop=True)


# ------------------------------------------------------------------------------------------------------------ fits


def data_of(
    lines: pd.DataFrame,
    errors: Sequence[str] = ("spread", "bias"),
    effects: Sequence[str] = ("first order", "zeroth order"),
) -> Data:
    """Return the searches of a class and target as data of a fit, with an effect for each kind in ``effects``."""
    runs = [len(times) for times in lines["times"]]
    index = np.repeat(np.arange(len(lines)), runs)
    times = np.concatenate(list(lines["times"])) if len(lines) else np.empty(0)
    budget = lines["budget"].to_numpy(float)[index]
    is_missed = ~np.isfinite(times)
    values = np.stack([_predictor(lines, name) for name in errors], axis=1)[index]
    kinds = lines["kind"].to_numpy()[index]
    columns = [kinds == kind for kind in effects]
    return Data(
        pd.factorize(lines["problem"])[0][index], np.log(np.where(is_missed, budget, np.maximum(times, 1.0))), is_missed,
        values, 1.0 / np.asarray(runs, dtype=float)[index],
        np.stack(columns, axis=1).astype(float) if columns else np.zeros((len(index), 0)),
    )  # fmt: skip


def _predictor(lines: pd.DataFrame, name: str) -> np.ndarray:
    values = lines[name].to_numpy(float)
    return np.asarray(np.maximum(1.0 - values, 0.0) if name in ("cosine", "sign_agreement") else values)


QUANTITIES: dict[str, Callable[[Fit], float]] = {
    "half": lambda f: f.growth(0.5, 0.0),
    "tenfold": lambda f: f.growth(1.0, 0.0) / f.growth(0.1, 0.0),
    "tenfold_bias": lambda f: f.growth(0.0, 0.5) / f.growth(0.0, 0.05),
    "bias_over_spread": lambda f: float(np.exp(f.log_c[1] - f.log_c[0])),
    "power": lambda f: f.power,
    "zeroth_over_first": lambda f: float(np.exp(f.effects[1] - f.effects[0])),
    "first_over_planted": lambda f: float(np.exp(f.effects[0])),
}
"""Quantities of a fit: updates with a random error of 0.5 over those without; a random error of 1 over 0.1; a bias of 0.5 over
0.05; c_b / c_s; p; natural zeroth order over first order, and first order over planted errors, at equal bias and spread."""


SHAPES: dict[str, Callable[[Fit], float]] = {
    "fixed_over_relative": lambda f: float(np.exp(f.effects[2])),
    "first_over_fixed": lambda f: float(np.exp(f.effects[0] - f.effects[2])),
    "zeroth_over_fixed": lambda f: float(np.exp(f.effects[1] - f.effects[2])),
}
"""Updates at equal median error, in a fit with an effect of planted noise of fixed size: of that noise over noise relative to the
gradient, and of natural first and zeroth order over that noise."""


@dataclass(frozen=True)
class ClassFit:
    """The quantities of one class and target, each with its interval."""

    scene_class: str
    target: float
    n: int
    """Problems that count."""
    missed: float
    """Share of searches that miss the target."""
    quantities: dict[str, Estimate]


def class_fits(
    lines: pd.DataFrame,
    targets: Sequence[float] = SHOWN,
    scatter: Scatter = "normal",
    draws: int = DRAWS,
    quantities_of: Mapping[str, Callable[[Fit], float]] = MappingProxyType(QUANTITIES),
    effects: Sequence[str] = ("first order", "zeroth order"),
) -> Iterator[ClassFit]:
    """Yield the fit of each class and target; without quantities where a class has too few problems."""
    for (scene_class, target), part in lines[lines["target"].isin(targets)].groupby(
        ["scene_class", "target"], sort=False
    ):
        n, data = part["problem"].nunique(), data_of(part, effects=effects)
        missed = float((data.weight * data.is_missed).sum() / data.weight.sum())
        quantities: dict[str, Estimate] = {}
        if n >= LEAST_PROBLEMS and not data.is_missed.all():
            fitted = fit(data, "floor", scatter)
            # a power at its bound is not identified, so nothing that follows from it is known
            samples = bootstrap(data, fitted, draws) if fitted.is_identified else []
            quantities = {
                name: estimate(value(fitted), [value(sample) for sample in samples], n)
                for name, value in quantities_of.items()
            }
        yield ClassFit(str(scene_class), float(target), n, missed, quantities)


def left_out(lines: pd.DataFrame, target: float = MAIN) -> pd.DataFrame:
    """Return, by class, how much better each form and predictor explains left-out problems than the main model.

    The main model is ``floor`` of the relative error. Columns: scene_class, model, gain (mean difference of log
    likelihood per search to the main model), low, high, n.
    """
    models = {"1 + c error^p": ("floor", "error"), "error^p": ("power", "error"), "no effect": ("none", "error")}
    models |= {f"1 + c ({name})^p": ("floor", name) for name in PREDICTORS[1:]}
    result = []
    for scene_class, part in lines[lines["target"] == target].groupby("scene_class", sort=False):
        if part["problem"].nunique() < LEAST_PROBLEMS:
            continue
        scores = {}
        for label, (form, name) in models.items():
            known = part[part[name].notna()]
            scores[label] = left_out_likelihoods(data_of(known, [name], effects=()), form)  # type: ignore[arg-type]
        main = scores.pop("1 + c error^p")
        for label, score in scores.items():
            gains = (score - main)[np.isfinite(score - main)]
            mean, low, high = mean_interval(gains)
            result.append(
                {"scene_class": scene_class, "model": label, "gain": mean, "low": low, "high": high, "n": gains.size}
            )
    return pd.DataFrame(result, columns=["scene_class", "model", "gain", "low", "high", "n"])


def mean_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Return a mean with its 95% interval by Student's t; an infinite interval for fewer than 3 values."""
    n = len(values)
    if n < 3:
        return (float(np.mean(values)) if n else math.nan), -math.inf, math.inf
    reach = float(stdtrit(n - 1, 0.975)) * float(np.std(values, ddof=1)) / math.sqrt(n)
    return float(np.mean(values)), float(np.mean(values)) - reach, float(np.mean(values)) + reach


# ------------------------------------------------------------------------------------------------------------ costs


def costs(lines: pd.DataFrame) -> pd.DataFrame:
    """Return, by class, target and ratio, on how many problems the first order is cheaper than the zeroth order.

    Each is taken at the number of samples with the lowest median cost. The ratio is the number of rollouts that a
    gradient is charged as; NaN is the measured one. Problems on which neither reaches the target are not counted.
    """
    natural = lines[lines["kind"].isin(("first order", "zeroth order")) & lines["target"].isin(SHOWN)]
    result = []
    for (scene_class, target), part in natural.groupby(["scene_class", "target"], sort=False):
        for ratio in (*RATIOS, math.nan):
            wins, total, logs = 0, 0, []
            for _, own in part.groupby("problem", sort=False):
                cheapest = own.assign(cost=rollouts_to_target(own, ratio)).groupby("kind")["cost"].min()
                first, zeroth = (float(cheapest.get(kind, math.inf)) for kind in ("first order", "zeroth order"))
                if math.isfinite(first) or math.isfinite(zeroth):
                    total, wins = total + 1, wins + (first < zeroth)
                if math.isfinite(first) and math.isfinite(zeroth):
                    logs.append(math.log(first / zeroth))
            low, high = wilson(wins, total) if total else (0.0, 1.0)
            result.append({
                "scene_class": scene_class, "target": target, "ratio": ratio, "wins": wins, "problems": total,
                "share": wins / total if total else math.nan, "share_low": low, "share_high": high,
                "cost_ratio": math.exp(float(np.median(logs))) if logs else math.nan,
                "verdict": "first order" if low > 0.5 else "zeroth order" if high < 0.5 else "not known",
            })  # fmt: skip
    columns = [
        "scene_class",
        "target",
        "ratio",
        "wins",
        "problems",
        "share",
        "share_low",
        "share_high",
        "cost_ratio",
        "verdict",
    ]
    return pd.DataFrame(result, columns=columns)


def rollouts_to_target(lines: pd.DataFrame, ratio: float) -> pd.Series:
    """Return the median cost in rollouts, a gradient charged as ``ratio`` of them, or with NaN as its measured time."""
    charge = lines["gradient_s"] / lines["rollout_s"] if math.isnan(ratio) else ratio
    return lines["median"] * (lines["rollouts_per_update"] + charge * lines["gradients_per_update"])


def cheapest_samples(lines: pd.DataFrame, target: float = MAIN) -> pd.DataFrame:
    """Return, by class and kind, how often the smallest number of samples that reaches the target is the cheapest.

    The cost of an update is nearly proportional to the samples, so the ratio of gradients to rollouts does not matter.
    """
    result = []
    natural = lines[lines["kind"].isin(("first order", "zeroth order")) & (lines["target"] == target)]
    for (scene_class, kind), part in natural.groupby(["scene_class", "kind"], sort=False):
        hits = total = 0
        for _, own in part[np.isfinite(part["median"])].groupby(["problem", "method"], sort=False):
            if len(own) > 1:
                total += 1
                hits += int(own["samples"].min() == own.loc[rollouts_to_target(own, 1.0).idxmin(), "samples"])
        low, high = wilson(hits, total) if total else (0.0, 1.0)
        result.append({"scene_class": scene_class, "kind": kind, "hits": hits, "of": total, "low": low, "high": high})
    return pd.DataFrame(result, columns=["scene_class", "kind", "hits", "of", "low", "high"])


def wrong_rates(lines: pd.DataFrame, target: float = MAIN) -> pd.DataFrame:
    """Return how many times the best gradient's updates grow at ten times and a tenth of its best rate, per problem.

    Infinite where the target is missed; NaN where the rate was not tried.
    """
    best = lines[(lines["kind"] == BEST) & (lines["target"] == target)]
    result = []
    for _, line in best.iterrows():
        at = {}
        for name, factor in (("above", 10.0), ("below", 0.1)):
            distance = np.abs(np.log(line["rates"] / (line["best_rate"] * factor)))
            at[name] = line["by_rate"][distance.argmin()] / line["floor"] if distance.min() < 0.1 else math.nan
        result.append({"problem": line["problem"], "scene_class": line["scene_class"], **at})
    return pd.DataFrame(result, columns=["problem", "scene_class", "above", "below"])


def median_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Return a median and its 95% interval between two order statistics, which holds for any distribution.

    k is the largest for which x_(k) and x_(n + 1 - k) enclose the median in 95% of samples; fewer than six values give 0
    and infinity. Infinite values are allowed. Source: David and Nagaraja 2003, Order Statistics, section 7.1.
    """
    values = np.sort(values)
    n = len(values)
    if not n:
        return math.nan, 0.0, math.inf
    k = sum(2 * bdtr(k, n, 0.5) <= 0.05 for k in range(n // 2))
    low, high = (float(values[k - 1]), float(values[n - k])) if k else (0.0, math.inf)
    return float(np.median(values)), low, high


ALL = "all classes"
"""The name of all problems together."""
RANDOM_ONE, BIAS_BELOW_ONE = "random error 1", "bias 0.9"
BIAS_OVER_RANDOM = f"{BIAS_BELOW_ONE} / {RANDOM_ONE}"
TENFOLD = "random error 3 / 0.3"
COMPARISONS: dict[str, tuple[tuple[str, float], tuple[str, float]]] = {
    "random error 0.3": ((RANDOM, 0.3), (BEST, 0.0)),
    RANDOM_ONE: ((RANDOM, 1.0), (BEST, 0.0)),
    "random error 3": ((RANDOM, 3.0), (BEST, 0.0)),
    TENFOLD: ((RANDOM, 3.0), (RANDOM, 0.3)),
    "bias 0.6": ((BIAS, 0.6), (BEST, 0.0)),
    BIAS_BELOW_ONE: ((BIAS, 0.9), (BEST, 0.0)),
    BIAS_OVER_RANDOM: ((BIAS, 0.9), (RANDOM, 1.0)),
}
"""Planted errors that are compared on the same problem, by name: numerator and denominator, each a kind and a size."""


def paired(lines: pd.DataFrame, targets: Sequence[float] = SHOWN) -> pd.DataFrame:
    """Return, by class, target and comparison, the ratio of updates on the same problem: its median over problems.

    No model is fitted. A missed target is infinite, and a problem on which both are missed is left out. The class
    ``all classes`` has all problems. Columns: scene_class, target, comparison, problems, ratio, ratio_low, ratio_high (:func:`median_interval`).
    """
    result = []
    main = lines[lines["target"].isin(targets) & lines["kind"].isin((RANDOM, BIAS, BEST))]
    main = pd.concat([main, main.assign(scene_class=ALL)])
    for (scene_class, target), part in main.groupby(["scene_class", "target"], sort=False):
        by_size = {size: own.set_index("problem")["median"] for size, own in part.groupby(["kind", "dose"])}
        for name, sides in COMPARISONS.items():
            if not by_size.keys() >= set(sides):
                continue
            pairs = pd.concat([by_size[side] for side in sides], axis=1, join="inner").to_numpy(float)
            pairs = pairs[np.isfinite(pairs).any(axis=1)]
            value, low, high = median_interval(pairs[:, 0] / pairs[:, 1])
            result.append({
                "scene_class": scene_class, "target": target, "comparison": name, "problems": len(pairs), "ratio": value,
                "ratio_low": low, "ratio_high": high,
            })  # fmt: skip
    columns = ["scene_class", "target", "comparison", "problems", "ratio", "ratio_low", "ratio_high"]
    return pd.DataFrame(result, columns=columns)


def relative_times(lines: pd.DataFrame, target: float) -> pd.DataFrame:
    """Return the points of the chart: by class, kind and dose, median error and updates over the best gradient's.

    The interval is that of a median over problems. Where half of the problems miss the target the time is missing and
    ``is_missed`` is true.
    """
    part = lines[(lines["target"] == target) & (lines["kind"] != BEST)]
    part = part.assign(size=part["dose"].fillna(part["samples"]), relative=part["median"] / part["floor"])
    result = []
    for (scene_class, kind, method, size), own in part.groupby(["scene_class", "kind", "method", "size"], sort=False):
        values = own["relative"].to_numpy()
        value, low, high = median_interval(values)
        result.append({
            "scene_class": scene_class, "kind": kind, "method": method, "size": size, "error": float(own["error"].median()),
            "time": value if math.isfinite(value) else math.nan, "time_low": low,
            "time_high": high, "is_missed": not math.isfinite(value),
            "problems": len(own), "reached": float(np.isfinite(values).mean()),
        })  # fmt: skip
    return pd.DataFrame(result)


def second_analysis(lines: pd.DataFrame, draws: int = 40) -> pd.DataFrame:
    """Return main quantities by class under other assumptions: another scatter, other targets, and half of the problems."""
    order = np.random.default_rng(0).permutation(lines["problem"].unique())
    halves = {f"half of the problems ({name})": set(order[i::2]) for i, name in enumerate(("first", "second"))}
    names = ("tenfold", "bias_over_spread")
    cases: list[tuple[str, pd.DataFrame, float, Scatter]] = [
        ("main", lines, MAIN, "normal"), ("Weibull times", lines, MAIN, "extreme"), ("target 1/30", lines, 30.0, "normal"),
        ("target 1/300", lines, 300.0, "normal"),
        *((label, lines[lines["problem"].isin(half)], MAIN, "normal") for label, half in halves.items()),
    ]  # fmt: skip
    result = []
    for label, chosen, target, scatter in cases:
        for one in class_fits(chosen, [target], scatter, draws, {name: QUANTITIES[name] for name in names}):
            entry: dict[str, Any] = {"scene_class": one.scene_class, "analysis": label, "problems": one.n}
            for name in names:
                quantity = one.quantities.get(name, Estimate(math.nan, math.nan, math.nan, one.n))
                entry |= {name: quantity.value, f"{name}_low": quantity.low, f"{name}_high": quantity.high}
            result.append(entry)
    return pd.DataFrame(result)


def shapes(lines: pd.DataFrame) -> pd.DataFrame:
    """Return :data:`SHAPES` by class and target, a comparison that was not planned before the run."""
    result = []
    for one in class_fits(lines, SHOWN, quantities_of=SHAPES, effects=("first order", "zeroth order", FIXED)):
        entry: dict[str, Any] = {"scene_class": one.scene_class, "target": one.target, "problems": one.n}
        for name in SHAPES:
            quantity = one.quantities.get(name, Estimate(math.nan, math.nan, math.nan, one.n))
            entry |= {name: quantity.value, f"{name}_low": quantity.low, f"{name}_high": quantity.high}
        result.append(entry)
    return pd.DataFrame(result)
