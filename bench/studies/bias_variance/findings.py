"""States what the comparisons show in at most three sentences: what to use, what fails, and what removes the failure."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from types import MappingProxyType

import numpy as np
import pandas as pd

from bench.report.text import axis_value, counted, number
from bench.studies.bias_variance.comparisons import (
    FAILS,
    NO_RESULT,
    OPEN,
    ROLLOUTS,
    WORKS,
    estimators,
    known,
    leaders,
    not_excluded,
    verdicts_by_estimator,
)

COUNTS = ("samples", ROLLOUTS.column)
"""Axes of numbers of samples or rollouts."""
NAMED = 3
"""Most problems or estimators that a sentence names."""
FEWEST = 3
"""Fewest problems, without an axis, that are compared by the worst case instead of by the number of wins."""


def findings(
    methods: pd.DataFrame, comparisons: pd.DataFrame, marks: Mapping[str, float] = MappingProxyType({})
) -> list[str]:
    """Return the findings on errors at equal samples; ``marks`` are named values of the swept axis."""
    compared = comparisons[comparisons["first"] != ""]
    if compared.empty:
        return ["No cell has an error that could be compared: the table has the reason of each."]
    if (methods["axis"] == "").all() and methods["problem"].nunique() >= FEWEST:
        texts = [
            _worst_case(methods),
            _record(estimators(methods)[0], methods, comparisons),
            _share_that_fails(methods),
        ]
    else:
        main = recommended(methods, comparisons)
        texts = [_use(main, methods, comparisons), *_failures(main, methods, comparisons, marks)]
    return list(filter(None, texts))[:3]


def recommended(methods: pd.DataFrame, comparisons: pd.DataFrame) -> str:
    """Return the estimator that is most often first or tied with the first and certain to be better than zero there."""
    working = set(methods.loc[methods["verdict"] == WORKS, ["estimator", "setting"]].itertuples(index=False, name=None))
    wins = Counter(
        (name, (name, place) in working) for place, names in leaders(comparisons, methods).items() for name in names
    )
    return max(estimators(methods), key=lambda name: (wins[name, True], wins[name, False]))


def best_elsewhere(main: str, methods: pd.DataFrame, comparisons: pd.DataFrame, places: Collection[str]) -> str:
    """Return the estimator, other than ``main``, that is most often first or tied at some settings; empty if none is."""
    named = leaders(comparisons, methods)
    wins = Counter(name for place in places for name in named.get(place, []) if name != main)
    return max(estimators(methods), key=lambda name: wins[name]) if wins else ""


# --------------------------------------------------------------------------------------------------- sentences


def _use(main: str, methods: pd.DataFrame, comparisons: pd.DataFrame) -> str:
    """Return the recommendation: where an estimator has the lowest error, alone or tied, and that error."""
    named = {place: names for place, names in leaders(comparisons, methods).items() if names}
    works = set(methods.loc[(methods["estimator"] == main) & (methods["verdict"] == WORKS), "setting"])
    mine = {place for place, names in named.items() if main in names and place in works}
    alone = {place for place in mine if named[place] == [main]}
    errors = _errors(methods, main, mine)
    if not errors:
        return f"No estimator is certain to be better than the zero estimate; {main} most often has the lowest error."
    how = (
        "has the lowest error"
        if alone == mine
        else "has the lowest error or ties"
        if alone
        else "ties for the lowest error"
    )
    where = _where(methods, mine, named)
    return f"Use {main} {where}: it {how}{work_of_a_sample(methods)} (relative RMSE {value_range(errors)})."


def _worst_case(methods: pd.DataFrame) -> str:
    """Return the estimators with the lowest worst case among those that have a number on every problem."""
    worst = {}
    for name, part in methods.groupby("estimator", sort=False):
        if part["problem"].nunique() == methods["problem"].nunique() and np.isfinite(part[["error", "high"]]).all(
            axis=None
        ):
            worst[str(name)] = part.loc[part["error"].idxmax()]
    if not worst:
        return "No estimator has a number on every problem."
    best = min(worst, key=lambda name: worst[name]["error"])
    tied = [n for n, row in worst.items() if n != best and not row["low"] > worst[best]["high"]]
    errors = methods.loc[methods["estimator"] == best, "error"]
    others = _join(tied) if len(tied) < NAMED else f"{len(tied)} others"
    also = f", not distinguishable from {others}" if tied else ""
    return (
        f"{best} has the lowest worst case on the {methods['problem'].nunique()} problems{work_of_a_sample(methods)}: "
        f"{value_range(errors)}{also}."
    )


def work_of_a_sample(methods: pd.DataFrame) -> str:
    """Return that errors are at equal samples and what a sample takes, where estimators differ in that; else empty."""
    compared = methods[methods["axis"] != ROLLOUTS.column]
    each = known(compared["evaluations"].round())
    if not each or min(each) == max(each):
        return ""
    return f" at equal samples, each of {axis_value(min(each))} to {axis_value(max(each))} rollouts or gradients"


def _record(name: str, methods: pd.DataFrame, comparisons: pd.DataFrame) -> str:
    """Return on which problems an estimator is first or tied, fails, and is open."""
    own = methods[methods["estimator"] == name]
    mine = {place for place, names in leaders(comparisons, methods).items() if name in names}
    parts = []
    if mine:
        problems = own.loc[own["setting"].isin(mine), "problem"]
        parts.append(f"is best or tied on {_names(problems)} ({value_range(_errors(methods, name, mine))})")
    for kind, verb in ((FAILS, "fails on"), (NO_RESULT, "has no result on"), (OPEN, "is open on")):
        part = own[own["verdict"] == kind]
        if len(part):
            least = f" (at least {number(min(part['low']))} times the gradient)" if kind == FAILS else ""
            parts.append(f"{verb} {_names(part['problem'])}{least}")
    return f"{name} {_join(parts)}." if parts else ""


def _names(problems: Iterable[str]) -> str:
    return _join(list(dict.fromkeys(problems)))


def _join(parts: Sequence[str]) -> str:
    """Join parts as ``a, b and c``; with `` and `` after a comma where a part has commas itself."""
    if len(parts) < 2:
        return "".join(parts)
    between = ", and " if any("," in part for part in parts) else " and "
    return ", ".join(parts[:-1]) + between + parts[-1]


def _failures(main: str, methods: pd.DataFrame, comparisons: pd.DataFrame, marks: Mapping[str, float]) -> list[str]:
    """Return what fails: the recommended estimator with the best alternative, and how many estimators never fail."""
    own = methods[methods["estimator"] == main]
    failing = set(own.loc[own["verdict"].isin((FAILS, NO_RESULT)), "setting"])
    texts = []
    if failing:
        where = _where(methods, failing, set(own["setting"]), marks)
        lows = known(_at(methods, main, failing)["low"])
        how = f"its error is at least {number(min(lows))} times the gradient" if lows else "it has no result"
        text = f"{main} fails {where}: {how}"
        other = best_elsewhere(main, methods, comparisons, failing)
        errors = _errors(methods, other, failing)
        if errors and (_at(methods, other, failing)["verdict"] == WORKS).all():
            text += f", where {other} is usable ({value_range(errors)})"
        texts.append(f"{text}.")
        texts += _remedy(main, methods, failing)
    else:
        named = leaders(comparisons, methods)
        beaten = {place for place, names in named.items() if names and main not in names}
        tied = not_excluded(comparisons, methods)
        for verb, places in (
            ("is better", {place for place in beaten if main not in tied[place]}),
            ("may be better", {place for place in beaten if main in tied[place]}),
        ):
            other = best_elsewhere(main, methods, comparisons, places)
            ahead = {place for place in places if other in named[place]}
            if not other or not ahead:
                continue
            where = _where(methods, ahead, named)
            own_errors = _errors(methods, main, ahead)
            against = f", where {main} has {value_range(own_errors)}" if own_errors else f", where {main} was not run"
            open_ = "; more repeats would decide it" if verb == "may be better" else ""
            texts.append(f"{other} {verb} {where}: {value_range(_errors(methods, other, ahead))}{against}{open_}.")
    return [*texts, _share_that_fails(methods)]


def _share_that_fails(methods: pd.DataFrame) -> str:
    """Return how many estimators fail somewhere, and how many are below the gradient's norm everywhere."""
    counts = verdicts_by_estimator(methods)
    failing = counts[counts[FAILS] + counts[NO_RESULT] > 0]
    sound = counts[(counts[FAILS] + counts[NO_RESULT] + counts[OPEN]) == 0]
    total = counted(len(counts), "estimator")
    if len(sound) == len(counts):
        return f"Every one of the {total} has an error below the gradient's norm at every setting."
    names = f" ({', '.join(sound.index)})" if 0 < len(sound) <= NAMED else ""
    open_ = len(counts) - len(failing) - len(sound)
    return (
        f"{len(failing) or 'None'} of {total} {_verb(len(failing), 'fail')} at some setting, {len(sound) or 'none'} "
        f"{_verb(len(sound) or 1, 'work')} at every setting{names}"
        + (f", {open_} {_verb(open_, 'is', 'are')} open." if open_ else ".")
    )


def _remedy(main: str, methods: pd.DataFrame, failing: Collection[str]) -> list[str]:
    """Return which contact law or integrator removes a failure at the same values of the axis, and its cost in time."""
    own = methods[methods["estimator"] == main]
    bad = own[own["setting"].isin(failing)]
    for kind in ("contact", "integrator"):
        wrong = set(bad[kind])
        others = own[~own[kind].isin(wrong) & own["at"].isin(bad["at"]) & own["scene"].isin(bad["scene"])]
        if others.empty or "none" in wrong or not (others["verdict"] == WORKS).all():
            continue
        before = own[own[kind].isin(wrong)].groupby("at")["time_s"].min()
        after = others.groupby("at")["time_s"].min()
        factor = float((after / before.reindex(after.index)).median())
        cost = f", at {number(factor)} times the time" if math.isfinite(factor) and factor > 1.2 else ""
        laws = " or ".join(dict.fromkeys(others[kind]))
        return [f"With {laws} {main} does not fail there ({value_range(others['error'])}){cost}."]
    return []


# ------------------------------------------------------------------------------------------------------- parts


def _verb(count: int, one: str, many: str = "") -> str:
    return (one if many else f"{one}s") if count == 1 else many or one


def _at(methods: pd.DataFrame, estimator: str, places: Collection[str]) -> pd.DataFrame:
    return methods[(methods["estimator"] == estimator) & methods["setting"].isin(places)]


def _errors(methods: pd.DataFrame, estimator: str, places: Collection[str]) -> list[float]:
    return known(_at(methods, estimator, places)["error"])


def value_range(values: Sequence[float] | pd.Series) -> str:
    """Format the range of values: ``0.12``, or ``0.10 to 0.15``."""
    low, high = number(min(values)), number(max(values))
    return low if low == high else f"{low} to {high}"


def _where(
    methods: pd.DataFrame,
    holds: Collection[str],
    tried: Collection[str],
    marks: Mapping[str, float] = MappingProxyType({}),
) -> str:
    """Format where something holds among the settings where it was tried.

    ``everywhere``, ``beyond the step size limit (6400) with penalty``, ``up to stiffness 3000 with penalty``, ``on pushing
    and heaviside``, ``at 12 of 20 settings``.
    """
    rows = methods[methods["setting"].isin(tried)].drop_duplicates("setting")
    mask = rows["setting"].isin(holds).to_numpy()
    if mask.all():
        return "everywhere" if len(rows) > 1 else f"on {rows['problem'].iloc[0]}"
    by_problem = {
        name: {float(x): bool(h) for x, h in zip(part["at"], mask[rows["problem"] == name], strict=True)}
        for name, part in rows.groupby("problem", sort=False)
    }
    some = {name: at for name, at in by_problem.items() if any(at.values())}
    n_settings = f"at {int(mask.sum())} of {counted(len(rows), 'setting')}"
    if (rows["axis"] == "").all():
        return (
            f"on {_names(some)}" if len(some) <= NAMED else f"on {len(some)} of {counted(len(by_problem), 'problem')}"
        )
    if rows["axis"].nunique() > 1:
        return n_settings
    axis = rows["axis"].iloc[0]
    spans = {name: span(at, axis, marks) for name, at in some.items()}
    for kind in ("contact", "scene", "integrator"):
        kinds = dict(zip(rows["problem"], rows[kind], strict=True))
        by_kind = {
            k: {spans.get(name, "") for name in kinds if kinds[name] == k} for k in dict.fromkeys(kinds.values())
        }
        if len(by_kind) > 1 and "none" not in by_kind and all(len(s) == 1 for s in by_kind.values()):
            word = "on" if kind == "scene" else "with"
            held: dict[str, list[str]] = {}
            for name, (where,) in by_kind.items():
                if where:
                    held.setdefault(where, []).append(name)
            parts = [f"{where} {word} {_join(names)}" for where, names in held.items()]
            if len(parts) <= NAMED:
                return ", and ".join(parts) if any(" and " in part for part in parts) else " and ".join(parts)
    if len(set(spans.values())) == 1 and len(some) == len(by_problem):
        return next(iter(spans.values()))
    if len(set(spans.values())) == 1 and len(some) <= NAMED:
        return f"{next(iter(spans.values()))} on {_names(some)}"
    if len(some) <= 2:
        return _join([f"{where} on {name}" for name, where in spans.items()])
    return n_settings


def span(where: Mapping[float, bool], axis: str, marks: Mapping[str, float] = MappingProxyType({})) -> str:
    """Format where something holds along an axis: ``up to stiffness 3000``, ``at every stiffness``, ``at 10 and 100``."""
    if all(where.values()):
        if axis in COUNTS and len(where) == 1:
            return f"at {axis_value(next(iter(where)))} {axis}"
        return f"at every {f'number of {axis}' if axis in COUNTS else axis}"
    values = list(where)
    runs = [[x for x, _ in run] for holds, run in itertools.groupby(where.items(), lambda item: item[1]) if holds]
    if len(runs) == 1:
        first, last = runs[0][0], runs[0][-1]
        if last == values[-1]:
            before = values[values.index(first) - 1]
            name = next((name for name, value in marks.items() if before <= value < first), "")
            return f"beyond the {name} ({axis} {axis_value(marks[name])})" if name else _from(axis, "from", first)
        if first == values[0]:
            return _from(axis, "up to", last)
    texts = [axis_value(r[0]) if len(r) == 1 else f"{axis_value(r[0])} to {axis_value(r[-1])}" for r in runs]
    return f"at {axis} {' and '.join(texts)}"


def _from(axis: str, word: str, value: float) -> str:
    """Format an end of a range: ``from stiffness 1e4``, ``with at most 256 samples``."""
    if axis in COUNTS:
        return f"with at {'least' if word == 'from' else 'most'} {axis_value(value)} {axis}"
    return f"{word} {axis} {axis_value(value)}"
