"""Compares searches on the same problem: ratios of updates and of rollouts, each with a test that counts scenes."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import bdtr

from bench.report.text import axis_value

from .search import TARGETS

CLASSES = ("smooth", "stiff", "discontinuous", "chaotic", "identification")
"""The classes of problems, in the order in which they are shown."""
ALL = "all classes"
"""The name of all problems together."""
MAIN = 100.0
"""The target of the main chart."""
SHOWN = (10.0, 100.0, 1000.0)
LEAST_UPDATES = 5
"""Fewest updates of the best gradient at which a problem counts for a target."""
CHARGES = {"1": 1.0, "2": 2.0, "4": 4.0, "measured": math.nan}
"""Rollouts that a gradient is charged as."""
BEST, RANDOM, FIXED, TAILS, BIAS, ROTATION = (
    "best gradient",
    "random error",
    "random error of fixed size",
    "heavy-tailed error",
    "bias",
    "rotation",
)
PLANTED = (RANDOM, FIXED, TAILS, BIAS, ROTATION)
COSTS_ONLY = "costs only"
ORDERS = ("first order", "zeroth order")
DOSES = {"noise": RANDOM, "bias": BIAS, "angle": ROTATION}
"""Parameters of an estimator with a planted error, and the kind of error."""
SIZES = ((RANDOM, 0.3), (RANDOM, 1.0), (RANDOM, 3.0), (BIAS, 0.6), (BIAS, 0.9))
COMPARISONS = {
    "random error 3 / 0.3": (SIZES[2], SIZES[0]),
    **{f"{kind} {size:g}": ((kind, size), (BEST, 0.0)) for kind, size in SIZES},
    "bias 0.9 / random error 1": (SIZES[4], SIZES[1]),
}
"""Planted errors that are compared on the same problem, by name: numerator and denominator, each a kind and a size."""
MEASURED = ("error", "bias", "rollouts_per_update", "gradients_per_update", "rollout_s", "gradient_s")


def searches(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per problem, method and target, with the updates of its runs, infinite where they were missed.

    Columns: problem, scene, scene_class, kind, method, dose, target, times (list), median, and the row's measurements.
    Methods that use costs only have kind ``costs only``. Copies of the best gradient with fewer samples are left out.
    """
    lines = []
    for _, row in rows[rows["status"] == "ok"].iterrows():
        kind, dose = _kind(row)
        shape = (-1, len(TARGETS))
        times = np.nan_to_num(np.asarray(row["updates"], dtype=float), nan=np.inf).reshape(shape[::-1])
        by_rate = np.nan_to_num(np.asarray(row["rate_updates"], dtype=float), nan=np.inf).reshape(shape)
        lines += [
            {
                "problem": problem_name(row),
                "scene": row["scene"],
                "scene_class": row["scene_class"],
                "kind": kind,
                "method": _method(row, kind),
                "dose": dose,
                "target": target,
                "times": times[k],
                "median": float(np.median(times[k])),
                "samples": row["samples"],
                "rates": np.asarray(row["rates"], dtype=float),
                "by_rate": by_rate[:, k],
                "best_rate": row["best_rates"][k],
                **{name: row[name] for name in MEASURED},
            }
            for k, target in enumerate(TARGETS)
        ]
    table = pd.DataFrame(lines)
    if table.empty:
        return table
    # times belong to the problem, and only some of its cells may have been timed
    for name in ("rollout_s", "gradient_s"):
        table[name] = table.groupby("problem")[name].transform("median")
    table = table.sort_values("scene_class", key=lambda names: names.map(CLASSES.index), kind="stable")
    most = table[table["kind"] == BEST].groupby("problem")["samples"].max()
    copies = table["kind"].eq(BEST) & table["samples"].ne(table["problem"].map(most))
    return table[~copies].reset_index(drop=True)


def problem_name(row: Any) -> str:
    """Return a problem's name: scene with horizon and step, and contact law with stiffness."""
    numbers = {"T": row["horizon"], "dt": row["dt"]}
    parts = [str(row["scene"]), *(f"{name}={axis_value(value)}" for name, value in numbers.items() if value > 0)]
    law = row["contact"] if row["contact"] not in ("none", "") else ""
    stiffness = f"k={axis_value(row['stiffness'])}" if math.isfinite(row["stiffness"]) else ""
    return ", ".join(filter(None, [*parts, f"{law} {stiffness}".strip()]))


def _kind(row: Any) -> tuple[str, float]:
    """Return the kind of error that the estimator plants and its size; or the orders that it uses and NaN."""
    estimator = json.loads(row["parameters"]).get("estimator")
    if not estimator:
        return COSTS_ONLY, math.nan
    given = estimator.get("parameters", estimator)
    if not {*DOSES, "base", "scale", "tails"} <= set(given):
        uses = row["gradients_per_update"] > 0, row["rollouts_per_update"] > 0
        return {(True, False): ORDERS[0], (False, True): ORDERS[1]}.get(uses, "both orders"), math.nan
    name = next((name for name in DOSES if given[name]), "")
    if name == "noise" and (given["tails"] or given["scale"] == "start"):
        return TAILS if given["tails"] else FIXED, float(given[name])
    return DOSES.get(name, BEST), float(given.get(name, 0.0))


def _method(row: Any, kind: str) -> str:
    if kind == COSTS_ONLY:
        return str(row["optimizer"])
    if kind in (*PLANTED, BEST):
        return kind
    return f"{row['estimator']}[{row['estimator_params']}]" if row["estimator_params"] else str(row["estimator"])


def floors(table: pd.DataFrame) -> pd.DataFrame:
    """Return the best gradient's median updates per problem and target, and why the problem does not count, if so."""
    best = table.loc[table["kind"] == BEST, ["problem", "scene_class", "target", "median"]]
    few = "the best gradient needs " + best["median"].map("{:g}".format) + " updates"
    reason = few.where(best["median"] < LEAST_UPDATES, "")
    return best.rename(columns={"median": "floor"}).assign(
        reason=reason.mask(np.isinf(best["median"]), "the best gradient misses the target")
    )


def counted(table: pd.DataFrame) -> pd.DataFrame:
    """Return the lines that count: of eligible problems and known errors, with the best gradient's updates as ``floor``."""
    eligible = floors(table).query("reason == ''")[["problem", "target", "floor"]]
    merged = table.merge(eligible, on=["problem", "target"])
    return merged[merged["error"].notna() & (merged["kind"] != COSTS_ONLY)].reset_index(drop=True)


# ----------------------------------------------------------------------------------------------------------- ratios


def ratios(lines: pd.DataFrame) -> pd.DataFrame:
    """Return ratios on the same problem: columns scene_class, target, scene, problem, comparison, ratio.

    A missed target is infinite, and a problem on which both sides are missed has no ratio. Comparisons: of updates, by
    :data:`COMPARISONS`; of updates at a wrong rate with those at the best one; of rollouts, of the first with the zeroth order, each
    at its cheapest number of samples; of updates with an estimator at its best setting with the best gradient; of rollouts at the fewest samples that reach the target with the cheapest other number;
    and of updates at equal error, the median over the cells of an estimator with planted random errors between the planted sizes.
    """
    result = []
    keys = ["scene_class", "target", "scene", "problem"]
    for key, own in lines[lines["target"].isin(SHOWN)].groupby(keys, sort=False):
        for name, (over, under) in _sides(own):
            if not (math.isinf(over) and math.isinf(under)):
                result.append([*key, name, over / under])
    return pd.DataFrame(result, columns=[*keys, "comparison", "ratio"])


def _sides(own: pd.DataFrame) -> Iterator[tuple[str, tuple[float, float]]]:
    """Yield each comparison of one problem and target with its numerator and denominator."""
    by_size = own.groupby(["kind", "dose"])["median"].first().to_dict()
    for name, sides in COMPARISONS.items():
        if by_size.keys() >= set(sides):
            yield name, (by_size[sides[0]], by_size[sides[1]])
    for _, line in own[own["kind"] == BEST].iterrows():
        for name, factor in (("ten times the best rate", 10.0), ("a tenth of the best rate", 0.1)):
            distance = np.abs(np.log(line["rates"] / (line["best_rate"] * factor)))
            if distance.min() < 0.1:
                yield name, (line["by_rate"][distance.argmin()], line["floor"])
    natural = own[own["kind"].isin(ORDERS)]
    for label, charge in CHARGES.items() if natural["kind"].nunique() == 2 else ():
        cheapest = natural.assign(cost=rollouts_to_target(natural, charge)).groupby("kind")["cost"].min()
        yield f"{ORDERS[0]} / {ORDERS[1]}, gradient {label}", (cheapest[ORDERS[0]], cheapest[ORDERS[1]])
    for kind, part in natural[np.isfinite(natural["median"])].groupby("kind"):
        costs = rollouts_to_target(part.sort_values("samples"), 1.0).to_numpy()
        if part["method"].nunique() == 1 and len(costs) > 1:
            yield f"fewest samples / others, {kind}", (costs[0], costs[1:].min())
    planted = own[(own["kind"] == RANDOM) & np.isfinite(own["median"])].sort_values("error")
    for estimator, part in natural.groupby(natural["method"].str.split("[").str[0]):
        yield f"{estimator} / {BEST}", (part["median"].min(), part["floor"].iloc[0])
        between = part[part["error"].between(planted["error"].min(), planted["error"].max())]
        if len(between):
            expected = np.interp(*map(np.log, (between["error"], planted["error"], planted["median"])))
            yield (
                f"{estimator} / random error, equal error",
                (float((between["median"] / np.exp(expected)).median()), 1.0),
            )


def rollouts_to_target(lines: pd.DataFrame, charge: float) -> pd.Series:
    """Return the median cost in rollouts, a gradient charged as ``charge`` of them, or with NaN as its measured time."""
    charged = lines["gradient_s"] / lines["rollout_s"] if math.isnan(charge) else charge
    return lines["median"] * (lines["rollouts_per_update"] + charged * lines["gradients_per_update"])


def by_scene(known: pd.DataFrame) -> pd.DataFrame:
    """Return the median ratio over scenes, by class, target and comparison, with its 95% interval and verdict.

    Problems of one scene that differ in horizon, step or stiffness are not independent, so each scene has one value, the
    median over its problems. The verdict is that of the exact two-sided sign test at 5%, which no outcome of fewer than six
    scenes passes: the interval then excludes 1. ``above`` counts the scenes whose ratio is above 1.
    """
    result = []
    keys = ["scene_class", "target", "comparison"]
    for key, own in pd.concat([known, known.assign(scene_class=ALL)]).groupby(keys, sort=False):
        scenes = own.groupby("scene")["ratio"].median().to_numpy()
        value, low, high = median_interval(scenes)
        verdict = "above 1" if low > 1 else "below 1" if high < 1 else "not known"
        result.append([*key, len(own), len(scenes), int((scenes > 1).sum()), value, low, high, verdict])
    names = ["problems", "scenes", "above", "ratio", "ratio_low", "ratio_high", "verdict"]
    return pd.DataFrame(result, columns=[*keys, *names])


def median_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Return a median and its 95% interval between two order statistics, which holds for any distribution.

    k is the largest for which x_(k) and x_(n + 1 - k) enclose the median in 95% of samples; fewer than six values give 0
    and infinity. Infinite values are allowed. Source: David and Nagaraja 2003, Order Statistics, section 7.1.
    """
    values = np.sort(values)
    n = len(values)
    k = sum(2 * bdtr(k, n, 0.5) <= 0.05 for k in range(n // 2))
    low, high = (float(values[k - 1]), float(values[n - k])) if k else (0.0, math.inf)
    return float(np.median(values)), low, high


# ------------------------------------------------------------------------------------------------------- costs only


def reached(table: pd.DataFrame) -> pd.DataFrame:
    """Return a line per problem and method without a planted error, if some use costs only.

    Columns: problem, scene_class, kind, method, runs, hits (searches that reach 1/100), missed, rollouts_per_update, and evaluations
    with fewest and most over the searches, infinite where one misses: updates times the rollouts and gradients of an update.
    """
    main = table[~table["kind"].isin(PLANTED) & (table["target"] == MAIN)].copy()
    if not (main["kind"] == COSTS_ONLY).any():
        return main.iloc[:0]
    names = main["method"].str.partition("[")[0]
    main["method"] = names.where(main.groupby(names)["method"].transform("nunique") == 1, main["method"])
    spent = main["times"] * (main["rollouts_per_update"] + main["gradients_per_update"])
    main["missed"] = np.isinf(main["median"])
    main["hits"], main["runs"] = spent.map(lambda v: int(np.isfinite(v).sum())), spent.map(len)
    for name, end in (("evaluations", np.median), ("fewest", np.min), ("most", np.max)):
        main[name] = spent.map(end).mask(main["missed"])
    names = [
        "problem",
        "scene_class",
        "kind",
        "method",
        "runs",
        "hits",
        "missed",
        "rollouts_per_update",
        "evaluations",
        "fewest",
        "most",
    ]
    return main[names].reset_index(drop=True)
