"""What the study of training shows: returns by trainer over seeds, with bootstrap intervals, windows by length, and faults."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis, table, values_of
from bench.experiment.columns import Column, interval, setting, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Table, Views
from bench.measure.performance import bootstrap, interquartile_mean
from bench.measure.statistics import ends
from bench.report.problems import problem_names
from bench.report.views import arrange, attempted

from .. import PARTS
from .verdicts import RULES, judge, series

MIN_SEEDS = 5
"""Fewest seeds for an interval: a resample cannot leave the range of its values, which covers too little for fewer."""
OF_WINDOWS = ("window_bias", "window_bias_low", "window_bias_high", "window_gradient")
"""Columns of a run that are about its windows."""
PROBLEM, METHOD, VERDICT = text("problem"), text("method", label="trainer"), text("verdict")
FINAL = interval("final", label="final return", digits=3, log=False)
SUMMARY = (
    PROBLEM,
    METHOD,
    FINAL,
    interval("behind", label="behind the first", digits=3, log=False),
    VERDICT,
    setting("settings"),
    Column("tuned", label="at the choosing seeds", digits=3, log=False),
    setting("seeds"),
    setting("failed", label="not finite"),
    Column("steps", unit="steps", label="control steps", digits=3),
    Column("used", label="used steps", digits=3),
    interval("equal", label="at equal used steps", digits=3, log=False),
    Column("train_s", label="training", format="seconds"),
    Column("compile_s", label="compilation", format="seconds"),
    Column("gradient_typical", label="gradient norm"),
    Column("gradient_peak", label="largest gradient"),
    Column("cosine", label="cosine"),
)
WINDOW = setting("window", label="window", unit="steps")
WINDOWS = (
    PROBLEM,
    text("family", label="trainer"),
    WINDOW,
    Column("window_gradient", label="norm of the windows' gradient"),
    interval("window_bias", label="its bias"),
    Column("gradient_typical", label="gradient norm in training"),
    FINAL,
    VERDICT,
)
FAULTS = (
    PROBLEM,
    METHOD,
    setting("seed"),
    text("code", label="the log shows"),
    setting("update"),
    Column("value"),
)
STEP, TIME = (
    Column("step", label="control steps", log=False),
    Column("time", label="time of the updates", unit="s", log=True),
)
SEEDS = f"interquartile mean over seeds, with its 95% bootstrap interval from {MIN_SEEDS} seeds on"
NOTE = (
    f"final return: the mean undiscounted return of the deterministic policy from the same starts, {SEEDS}. A run that is not "
    "finite counts as its untrained policy. behind the first: the difference of both means, with its 95% bootstrap interval. used steps: control steps that updates use, median. at equal used steps: the return at "
    "the last evaluation within the used steps of the run that used fewest. training: "
    "median over seeds, without compilation and evaluations. gradient norm: median over updates before clipping, of the "
    "trainer's own objective, so compare it within a trainer only. cosine: between first- and zeroth-order gradients of the "
    "same objective along the runs, mean; noise in either lowers it."
)
WINDOW_NOTE = (
    "norm of the windows' gradient: of whole episodes from new starts, cut into windows that end in the critic's value, with the "
    "policy and critic halfway through the run, median over runs. bias: the distance from the gradient without cuts, relative "
    "to it, with its 95% interval, each the median over runs. The policies differ between windows. "
    f"final return: {SEEDS}."
)
FAULT_NOTE = "update: where it starts. value:"
VERDICTS = (
    "settings: how many of the trainer were tried. The best on the first third of the seeds (the choosing seeds, of which those count "
    "that all its settings have, if any) is chosen, the other "
    "seeds are reported; of fewer than 8 seeds all are reported, and choose. "
    "verdict: first, tied (not distinguishable), behind (by this interval and a Mann-Whitney test at 5%), not chosen, or open: none is behind, or only "
    "the first's larger number of settings puts it ahead (it would lead with the worst of as many settings). not run: chosen, but "
    "without reported seeds."
)
WINDOW_VERDICTS = "verdict: first, tied (not distinguishable), behind (by a bootstrap interval and a Mann-Whitney test at 5%), or open where none is behind."
PAGE = (
    "final_return",
    "first_return",
    "final_median",
    "updates",
    "steps",
    "train_s",
    "compile_s",
    "gradient_typical",
    "gradient_peak",
    "window_gradient",
    "window_bias",
)


def runs_of(experiment: Experiment, rows: pd.DataFrame) -> pd.DataFrame:
    """Return the runs that gave a curve, with the columns ``problem``, ``method``, ``family`` and ``window``.

    A method is a trainer with its parameters, its family the trainer's name.
    """
    runs = attempted(rows)
    runs = runs[runs["curve_return"].map(len) > 0]
    if runs.empty:
        return runs.assign(problem="", method="", family="", window=math.nan)
    names = problem_names(arrange(experiment, rows), PARTS, rows=runs)
    window = values_of(Axis("window", ("trainer.window",)), runs)
    return runs.assign(
        problem=names, method=runs["trainer"], family=runs["trainer"].str.partition("[")[0], window=window
    )


def final_returns(part: pd.DataFrame, column: str = "final_return") -> np.ndarray:
    """Return the final return of each run, ``(n,)``; a run that ended early counts as its untrained policy."""
    return np.asarray(part[column].where(part["status"] == "ok", part["first_return"]), dtype=float)


def used_steps(run: Mapping[str, Any]) -> np.ndarray:
    """Return the control steps that a run's updates used up to each evaluation, ``(n,)``: all, where the log has no share."""
    share = series(run["log_used"])
    if not share.size:
        return np.asarray(run["curve_step"], dtype=float)
    updates = np.append(0.0, run["log_update"])
    used = np.append(0.0, np.cumsum(share * np.diff(updates)))
    return np.interp(run["curve_update"], updates, used) * run["steps"] / run["updates"]


def at_equal_steps(runs: pd.DataFrame) -> pd.DataFrame:
    """Return runs with their ``used`` steps, and the return at the last evaluation within the fewest of their problem, ``equal``."""
    used = pd.Series([used_steps(run) for run in runs.to_dict("records")], runs.index)
    last = used.map(lambda steps: steps[-1])
    fewest = last.where(runs["status"] == "ok").groupby(runs["problem"]).transform("min")
    returns = [
        curve[max((steps <= limit).sum() - 1, 0)]
        for curve, steps, limit in zip(runs["curve_return"], used, fewest, strict=True)
    ]
    return runs.assign(used=last, equal=returns)


def summarise(runs: pd.DataFrame, by: Sequence[str] = ("problem", "method")) -> pd.DataFrame:
    """Return a line per problem and method, best first: interquartile mean of the final return over seeds, and medians."""
    lines = []
    for key, part in at_equal_steps(runs).groupby(list(by), sort=False):
        final, equal = final_returns(part), final_returns(part, "equal")
        cosines = np.concatenate([np.asarray(c, float) for c in part["cosine"]])
        lines.append(
            dict(zip(by, key, strict=True))
            | {
                "family": part["family"].iloc[0],
                "seeds": len(part),
                "failed": int((part["status"] != "ok").sum()),
                "returns": final,
                **middle_with_interval("final", final),
                "steps": float(part["steps"].max()),
                "used": float(part["used"].median()),
                **middle_with_interval("equal", equal),
                "train_s": float(part["train_s"].median()),
                "compile_s": float(part["compile_s"].max()),
                "gradient_typical": float(part["gradient_typical"].median()),
                "gradient_peak": float(part["gradient_peak"].max()),
                "cosine": float(np.nanmean(cosines)) if np.isfinite(cosines).any() else math.nan,
                **part[[*OF_WINDOWS]].median(),
            }
        )
    frame = pd.DataFrame(lines)
    return frame.sort_values(["problem", "final"], ascending=[True, False], kind="stable").reset_index(drop=True)


def split(runs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the runs of the first third of the seeds, which choose each trainer's setting, and those that are reported.

    None chooses where each trainer has one setting, and where too few would be left for a test.
    """
    seeds = sorted(runs["seed"].unique())
    several = (runs.groupby(["problem", "family"])["method"].nunique() > 1).any()
    count = math.ceil(len(seeds) / 3)
    chooses = runs["seed"].isin(seeds[:count] if several and len(seeds) - count >= MIN_SEEDS else [])
    return runs[chooses], runs[~chooses]


def tried(lines: pd.DataFrame, tuning: pd.DataFrame) -> pd.DataFrame:
    """Return lines of :func:`summarise` with each trainer's number of ``settings``, and ``tuned``: the return that chooses one.

    The settings of a trainer are compared on the seeds that all of them have, if there are any. A setting that has only the seeds that choose is a
    line without a ``final`` return.
    """
    keys = ["problem", "family", "method"]
    methods = tuning.groupby(keys[:2])["method"]
    has_all = tuning.groupby([*keys[:2], "seed"])["method"].transform("nunique") == methods.transform("nunique")
    has_all |= ~has_all.groupby([tuning[key] for key in keys[:2]]).transform("any")
    middles = [(*key, interquartile_mean(final_returns(part))) for key, part in tuning[has_all].groupby(keys)]
    lines = lines.merge(pd.DataFrame(middles, columns=[*keys, "tuned"]), how="outer", on=keys)
    lines["settings"] = lines.groupby(keys[:2])["method"].transform("size")
    return lines.sort_values(
        ["problem", "final", "tuned"], ascending=[True, False, False], kind="stable", ignore_index=True
    )


def ranked(lines: pd.DataFrame, by: Sequence[str], trainer: str = "family") -> pd.DataFrame:
    """Return a ``verdict`` on each line, within groups ``by``, of which a trainer's setting with the best ``tuned`` counts.

    ``behind`` is how much higher the first of its group ends than such a setting, with its interval.

    ``first``: the highest return; ``behind``: its runs end lower than those of the first, by this interval and the test of Mann and
    Whitney (1947) at 5%, even if the first had only its worst settings, as many as this one; ``tied``: they find no difference;
    ``open``: neither, or none of the group is behind; ``not run``: the chosen setting has no seeds that are reported;
    ``no result``: no run ended with a finite return.
    """
    verdicts = pd.Series("no result", lines.index, dtype=object)
    behind: dict[Any, Any] = {}
    has_ended = np.isfinite(lines["final"]) & (lines["failed"] < lines["seeds"])
    compared = lines[has_ended | ~(lines["seeds"] > 0)].sort_values(
        "tuned", ascending=False, kind="stable", na_position="last"
    )
    for _, part in compared.groupby(list(by), sort=False):
        found, distances = _ranked_group(part, trainer)
        verdicts[found.index], behind = found, behind | distances
    return pd.DataFrame({"verdict": verdicts}).join(pd.DataFrame(behind, index=ends("behind", "123")).T.astype(float))


def _ranked_group(part: pd.DataFrame, trainer: str) -> tuple[pd.Series, dict[Any, Any]]:
    """Return the verdicts on the lines of one group, the best ``tuned`` first, and the distances behind the first of the group."""
    verdicts, chosen = pd.Series("not chosen", part.index, dtype=object), part.drop_duplicates(trainer)
    is_run = chosen["seeds"] > 0
    verdicts[chosen.index[~is_run]], chosen = "not run", chosen[is_run]
    if chosen.empty:
        return verdicts, {}
    best, settings = chosen.loc[chosen["final"].idxmax()], dict(iter(part.groupby(trainer)["returns"]))
    own, behind = settings[best[trainer]], {}
    for index, line in chosen.drop(best.name).iterrows():
        behind[index], leads = distance_below(line["returns"], best["returns"])
        # the best of the worst settings of the first, as many as this trainer has; NaN if its seeds are not reported
        fewest = own.iloc[max(len(own) - len(settings[line[trainer]]), 0)]
        leads_by_fewer = isinstance(fewest, np.ndarray) and distance_below(line["returns"], fewest)[1]
        verdicts[index] = "tied" if not leads else "behind" if leads_by_fewer else "open"
    verdicts[best.name] = "first"
    if behind and not (verdicts[chosen.index] == "behind").any():
        verdicts[chosen.index] = "open"
    return verdicts, behind


def distance_below(returns: np.ndarray, others: np.ndarray) -> tuple[dict[str, Any], bool]:
    """Return by how much runs end lower than others, with an interval, and whether they do.

    They do if the interval is above 0 and the test of Mann and Whitney finds a difference, both at 5%.
    """
    from scipy.stats import mannwhitneyu

    distance = middle_with_interval("behind", returns, others)
    return distance, bool(distance["behind_low"] > 0.0 and mannwhitneyu(others, returns).pvalue < 0.05)


def middle_with_interval(name: str, values: np.ndarray, *above: np.ndarray) -> dict[str, Any]:
    """Return interquartile means over the first axis, or their distances below those ``above``, with bootstrap intervals by column.

    Of fewer than :data:`MIN_SEEDS` the interval is NaN.
    """

    def distance(parts: Sequence[np.ndarray]) -> Any:
        own, *others = map(interquartile_mean, parts)
        return others[0] - own if others else own

    parts = [values, *above]
    low = high = np.full(values.shape[1:], math.nan)[()]
    if min(map(len, parts)) >= MIN_SEEDS:
        low, high = bootstrap(parts, distance)
    return ends(name, (distance(parts), low, high))


def curves_of(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a line per problem, method and evaluation: cost of an episode, interquartile mean over seeds with interval.

    The cost is minus the return, and the time the median over runs. A run that ended early keeps the cost of its untrained
    policy from there on.
    """
    parts = []
    for (problem, method), part in runs.groupby(["problem", "method"], sort=False):
        curves = np.array([*zip_longest(*part["curve_return"], fillvalue=math.nan)], dtype=float).T
        costs = -np.where(np.isfinite(curves), curves, curves[:, :1])
        steps, times = max(part["curve_step"], key=len), pd.DataFrame([*part["curve_s"]]).median()
        times = times.reindex(range(len(steps))).to_numpy()
        named = {"problem": problem, "method": method, "step": np.asarray(steps, dtype=float), "time": times}
        parts.append(pd.DataFrame(named | middle_with_interval("cost", costs)))
    return pd.concat(parts, ignore_index=True)


def windows_of(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a line per problem, family and window with a run that ended, for families with several windows."""
    keys = ["problem", "family", "window"]
    known = runs[runs["window"].notna() & runs["window_gradient"].notna()]
    has_ended = (known["status"] == "ok").groupby([known[key] for key in keys]).transform("any")
    names = [*keys, "seeds", "failed", "returns", *OF_WINDOWS, "gradient_typical", "final", "final_low", "final_high"]
    if not has_ended.any():
        return pd.DataFrame(columns=names)
    frame = summarise(known[has_ended], keys)[names].sort_values(keys, ignore_index=True)
    return frame[frame.groupby(["problem", "family"])["window"].transform("nunique") > 1]


def faults_of(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a line per run and fault: problem, method, seed, and the fault's ``code``, ``value`` and ``update``."""
    lines = [
        {"problem": row["problem"], "method": row["method"], "seed": row["seed"], **fault}
        for row in runs.to_dict("records")
        for fault in judge(row)
    ]
    return pd.DataFrame(lines, columns=["problem", "method", "seed", "code", "update", "value"])


def views(experiment: Experiment, rows: pd.DataFrame) -> Views | None:
    """Return the tables and charts of the runs; None without any."""
    runs = runs_of(experiment, rows)
    if runs.empty:
        return None
    tuning, reported = split(runs)
    summary, windows, faults = tried(summarise(reported), tuning), windows_of(runs), faults_of(runs)
    summary = summary.join(ranked(summary, ["problem"])).drop(columns=["returns", *OF_WINDOWS])
    chosen = summary[~summary["verdict"].isin(["not chosen", "not run"])].set_index(["problem", "method"]).index
    shown = reported[pd.MultiIndex.from_frame(reported[["problem", "method"]]).isin(chosen)]
    tables = [
        Table(
            "train",
            summary,
            SUMMARY,
            "final return by trainer",
            [NOTE, VERDICTS],
            terminal=True,
            page=True,
            data=table(experiment, rows),
            details=["compile_s", "gradient_typical", "gradient_peak"],
        ),
        Table("summary", summary),
    ]
    if len(windows):
        lines = windows.join(ranked(windows.assign(tuned=0.0), ["problem", "family"], "window"))
        lines = lines.drop(columns=["returns", "failed"])
        tables.append(
            Table(
                "windows",
                lines,
                WINDOWS,
                "Windows",
                [WINDOW_NOTE, WINDOW_VERDICTS],
                terminal=True,
                details=["gradient_typical"],
            )
        )
    if len(faults):
        notes = [FAULT_NOTE, *(f"- {code}: {RULES[code][1]}" for code in faults["code"].unique())]
        tables.append(Table("faults", faults, FAULTS, "Faults in the logs", notes))
    cells = rows.assign(problem=runs["problem"], method=runs["method"]).fillna({"problem": "", "method": ""})
    by_name = experiment.columns.by_name
    return Views(tables, _charts(shown, windows), cells, [METHOD, *(by_name[name] for name in PAGE)])


def _charts(runs: pd.DataFrame, windows: pd.DataFrame) -> list[Chart]:
    frame = curves_of(runs)
    middles = "lower is better; interquartile mean over {:g} seeds".format
    reported = middles(runs["seed"].nunique())
    is_log = bool((frame["cost"] > 0).all())
    cost = interval("cost", label="minus the return of an episode", ends="95% interval over seeds", log=is_log)
    curves = Chart(
        "train",
        frame.dropna(subset=["step"]),
        [STEP],
        [cost],
        series="method",
        panel="problem",
        band=True,
        subtitle=reported,
    )
    times = replace(
        curves,
        name="times",
        frame=frame[frame["time"] > 0],
        x=[TIME],
        title="Which return is reached after which time of updates?",
        subtitle=f"{reported}, median time of runs beside other work",
    )
    final = windows.assign(cost=-windows["final"], cost_low=-windows["final_high"], cost_high=-windows["final_low"])
    lengths = Chart(
        "windows",
        final,
        [replace(WINDOW, log=True)],
        [cost],
        series="family",
        panel="problem",
        title="What does the length of a window do?",
        subtitle=f"after training; {middles(windows['seeds'].max())}",
    )
    return [curves, times, lengths]
