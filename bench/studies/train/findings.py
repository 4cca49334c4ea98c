"""States what runs show: which trainer ends best, what windows do, and which faults the logs have, in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from bench.report.text import counted, listed, number

NAMED = 3
"""Most tied methods that a sentence names."""
DIGITS = 3
"""Significant digits of returns."""
OPEN = frozenset({"differences"})
"""Codes of what may be a fault or not: jumps of a cost and rounding make central differences disagree as well."""


def sentences(summary: pd.DataFrame, windows: pd.DataFrame, faults: pd.DataFrame, n_runs: int) -> list[str]:
    """Return at most three findings: the trainer to use, the window to use, and the faults in the logs."""
    texts = [recommendation(summary), window(windows), frequent_faults(faults, n_runs)]
    return [sentence for sentence in texts if sentence]


def recommendation(summary: pd.DataFrame) -> str:
    """Return the best final return on each problem, the methods not distinguishable from it, and those behind."""
    parts = []
    for problem, part in summary.groupby("problem", sort=False):
        where = f" on {problem}" if summary["problem"].nunique() > 1 else ""
        # a method without a run that ended has the return of its untrained policy only
        has_ended = (part["failed"] < part["seeds"]) & np.isfinite(part["final"])
        lost = part[~has_ended]["method"]
        part = part[has_ended]
        if part.empty:
            parts.append(f"No run{where} ends with a finite return")
            continue
        best, tied, behind = ranked(part)
        value = f"The best final return{where} is {_interval(best)} ({best['method']}{_failed(best)})"
        if len(part) == 1:
            parts.append(f"The final return{where} of {best['method']} is {_interval(best)}{_failed(best)}")
        elif not math.isfinite(best["final_low"]):
            parts.append(
                f"Which trainer is best{where} is open, since {counted(best['seeds'], 'seed is', 'seeds are')} too few for an "
                f"interval: the highest final return is {number(best['final'], DIGITS)} ({best['method']}{_failed(best)})"
            )
        elif behind.empty:
            parts.append(
                f"Which trainer is best{where} is open: {best['method']} has {_interval(best)}{_failed(best)}, and no other is "
                "distinguishable"
            )
        else:
            also = f", not distinguishable from {_names(tied['method'])}" if len(tied) else ""
            ends = "ends lower" if len(behind) == 1 else "end lower"
            most = _interval(behind.iloc[0]) + (" or less" if len(behind) > 1 else "")
            parts.append(f"{value}{also}; {_names(behind['method'])} {ends} ({most})")
        if len(lost):
            parts[-1] += f"; no run of {_names(lost)} ends with a finite return"
    return f"{'. '.join(parts)}.".replace("; ", ", and ")


def ranked(part: pd.DataFrame) -> tuple[pd.Series, pd.DataFrame, pd.DataFrame]:
    """Return the line with the highest final return, those not distinguishable from it, and those certainly below it."""
    part = part.sort_values("final", ascending=False, kind="stable")
    best, others = part.iloc[0], part.iloc[1:]
    is_behind = np.array([is_below(row, best) for _, row in others.iterrows()], dtype=bool)
    return best, others[~is_behind], others[is_behind]


def is_below(row: Mapping[str, Any] | pd.Series, best: Mapping[str, Any] | pd.Series) -> bool:
    """Return whether a final return is certainly below another: their intervals over seeds do not overlap."""
    return bool(row["final_high"] < best["final_low"])


def _interval(row: pd.Series) -> str:
    value = number(row["final"], DIGITS)
    if not math.isfinite(row["final_low"]):
        return f"{value} (no interval)"
    return f"{value} [{number(row['final_low'], DIGITS)}, {number(row['final_high'], DIGITS)}]"


def _failed(row: pd.Series) -> str:
    return f", {row['failed']} of {row['seeds']} runs not finite" if row["failed"] else ""


def _names(methods: Iterable[str]) -> str:
    methods = list(methods)
    return listed(methods) if len(methods) <= NAMED else counted(len(methods), "other trainer")


def window(windows: pd.DataFrame) -> str:
    """Return which window ends best within each family, those not distinguishable from it, and those behind."""
    parts = []
    for (problem, family), part in windows.groupby(["problem", "family"], sort=False) if len(windows) else ():
        best, tied, behind = ranked(part.sort_values("window"))
        where = f" on {problem}" if windows["problem"].nunique() > 1 else ""
        also = f", not distinguishable from {_lengths(tied['window'])} steps" if len(tied) else ""
        if len(behind):
            shown = (
                f"{best['window']:.0f} steps end best{where}{also}, and {_lengths(behind['window'])} steps end lower"
            )
        else:
            shown = f"which length ends best{where} is open"
        parts.append(f"Among windows of {family}, {shown}")
    return f"{'. '.join(parts)}." if parts else ""


def _lengths(values: Any) -> str:
    return listed([f"{value:.0f}" for value in sorted(values)])


def bias_words(line: Mapping[str, Any]) -> str:
    """Return the bias of windows with its interval, or that none was found."""
    low, high = number(line["window_bias_low"]), number(line["window_bias_high"])
    return (
        f"{number(line['window_bias'])} [{low}, {high}]"
        if line["window_bias_low"] > 0
        else f"not distinguishable from 0 (up to {high})"
    )


def frequent_faults(faults: pd.DataFrame, n_runs: int) -> str:
    """Return in how many runs the logs show a fault, the words of the most frequent one, and in how many one is open."""
    known = certain(faults)
    unknown = _runs(faults.drop(known.index))
    also = f", and in {unknown} central differences do not agree with the gradient, which is open" if unknown else ""
    if known.empty:
        return f"The logs of {counted(n_runs, 'run')} show no fault{also}."
    codes = known["fault"].map(lambda fault: fault["code"])
    first = known[codes == codes.mode().iloc[0]].iloc[0]
    words = f"{describe(first['fault'])} ({first['method']}, seed {first['seed']:.0f})"
    return f"The logs of {_runs(known)} of {counted(n_runs, 'run')} show a fault, most often this: {words}{also}."


def certain(faults: pd.DataFrame) -> pd.DataFrame:
    """Return the faults that are certain, without what is open."""
    return faults[[fault["code"] not in OPEN for fault in faults["fault"]]]


def _runs(faults: pd.DataFrame) -> int:
    return len(faults[["problem", "method", "seed"]].drop_duplicates())


# ------------------------------------------------------------------------------------------------------ one fault


def describe(fault: Mapping[str, Any]) -> str:
    """Return a fault in words with its numbers, as a clause without a full stop."""
    return WORDS[fault["code"]](fault)


def _explodes(fault: Mapping[str, Any]) -> str:
    start, update = fault.get("contact"), fault["update"]
    when = f"at update {update}"
    if start is not None:
        lag = update - start
        after = "in the update in which" if lag == 0 else f"{counted(lag, 'update')} after"
        when = f"{after} the contact starts (update {update})"
    text = f"the gradient explodes {when}, to {number(fault['factor'])} times its median before"
    if fault.get("lasting"):
        text += f", and stays at about {number(fault['lasting'])} times"
    if fault["peaks"] > 1:
        text += ", and once more" if fault["peaks"] == 2 else f", and {fault['peaks'] - 1} more times"
    if fault.get("with_contact") is not None and fault["peaks"] > 1:
        text += f" ({fault['with_contact']} of {fault['peaks']} peaks in updates with contact)"
    return text


def _zero(fault: Mapping[str, Any]) -> str:
    everywhere = fault["zero"] == fault["updates"]
    span = (
        f"in all {fault['updates']} updates"
        if everywhere
        else f"from update {fault['update']} on, in {fault['zero']} of {fault['updates']} updates"
    )
    return f"the gradient is exactly zero {span}"


def _soft_contact(fault: Mapping[str, Any]) -> str:
    growth = "doubles" if fault["factor"] < 3 else f"grows {number(fault['factor'])} times"
    depth = f"{number(fault['before'])} to {number(fault['after'])} m"
    reward = f"{number(fault['reward_before'])} to {number(fault['reward_after'])}"
    return f"the reward rises ({reward} per step) while the penetration {growth} ({depth}): the policy uses the soft contact"


def _worse(fault: Mapping[str, Any]) -> str:
    return (
        f"the loss falls ({number(fault['loss_before'])} to {number(fault['loss_after'])}) while the return worsens from "
        f"{number(fault['best'], DIGITS)} at update {fault['update']} to {number(fault['last'], DIGITS)}"
    )


WORDS: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "not_finite": lambda f: f"NaN at update {f['update']}: the {f['quantity']} is not finite",
    "zero": _zero,
    "explodes": _explodes,
    "returns": lambda f: (
        f"the gradient nearly vanishes before update {f['update']} and then grows {number(f['factor'])} times, to its usual size"
    ),
    "vanishes": lambda f: (
        f"the gradient nearly vanishes from update {f['update']} on, {number(f['factor'])} times below its size before, and the "
        "return rises no more, so that the training has converged or is stuck"
    ),
    "grows": lambda f: (
        f"the gradient grows step by step, {number(f['factor'])} times in all, and is above 100 times its first size from "
        f"update {f['update']} on"
    ),
    "differences": lambda f: (
        f"open: central differences at the steps tried do not agree with the gradient (relative error of at least {number(f['error'])}), "
        "which decides nothing where the cost has jumps or rounding is large"
    ),
    "opposed": lambda f: (
        "the first-order gradient points away from the zeroth-order one: cosine "
        f"{number(f['cosine'])} [{number(f['low'])}, {number(f['high'])}]"
    ),
    "worse": _worse,
    "soft_contact": _soft_contact,
    "parameters": lambda f: (
        f"the policy's parameters are unphysical: the largest is {number(f['value'])} at update {f['update']}, "
        f"{number(f['first'])} at first"
    ),
    "deviation": lambda f: f"the actions' deviation is unphysical: {number(f['value'])} at update {f['update']}",
    "cut": lambda f: f"the gradient is cut in {f['share']:.0%} of windows, so that it seldom reaches their ends",
}
"""Words of each fault, by its code."""


def title(summary: pd.DataFrame) -> str:
    """Return the title of the curves: the best method, or that it is open; or on how many problems methods are behind the best."""
    problems = [part for _, part in summary.groupby("problem", sort=False)]
    if len(problems) == 1:
        return recommendation(summary).partition(", and ")[0].rstrip(".")
    decided = sum(len(ranked(part)[2]) > 0 for part in problems)
    return f"Trainers end lower than the best on {decided} of {len(problems)} problems"


def window_title(windows: pd.DataFrame) -> str:
    """Return the title of the windows: the length that ends best, or that it is open; or on how many problems it does."""
    problems = windows["problem"].nunique()
    if problems == 1:
        return window(windows).split(".")[0]
    parts = []
    for family, own in windows.groupby("family", sort=False):
        every = [ranked(part) for _, part in own.groupby("problem", sort=False)]
        decided = pd.Series([best["window"] for best, _, behind in every if len(behind)], dtype=float).value_counts()
        shown = [f"{length:.0f} steps end best on {n} of {problems} problems" for length, n in decided.items()]
        parts.append(f"Among windows of {family}, {listed(shown) if shown else 'which length ends best is open'}")
    return ". ".join(parts)
