"""What the study of errors shows: the cost of an error by class, hypotheses with their verdicts, methods, and costs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from bench.experiment.axes import table as csv_table
from bench.experiment.columns import Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Table, Views
from bench.measure.performance import wilson
from bench.report.style import PALETTE, VARIANTS
from bench.report.text import interval as text_of_interval
from bench.report.text import listed, number
from bench.report.writer import reasons
from bench.studies.dose_response import analysis, controls
from bench.studies.dose_response.analysis import BEST, BIAS, FIXED, MAIN, RANDOM, ROTATION, SHOWN, TAILS, ClassFit
from bench.studies.dose_response.model import Estimate

CLOSE = 1.5
"""Ratio of updates within which two methods of equal error count as equal."""
CHEAP, EXPENSIVE = 1.25, 2.0
"""Factors on the updates below which an error of a half counts as small at 1/10, and above which as large at 1/1000."""
STYLES = {
    RANDOM: Style(PALETTE[0], "o"),
    FIXED: Style(PALETTE[0], "s", VARIANTS[1]),
    TAILS: Style(PALETTE[6], "D", VARIANTS[2]),
    BIAS: Style(PALETTE[2], "^"),
    ROTATION: Style(PALETTE[2], "v", VARIANTS[1]),
}
NATURAL = ((PALETTE[3], "P"), (PALETTE[5], "*"), (PALETTE[4], "h"), (PALETTE[7], "p"))
"""Colour and marker of each natural method, drawn as points."""
CLASS = text("scene_class", label="class")
TARGET = text("target_name", label="regret")
PROBLEMS = Column("problems", format="setting")


def interval(name: str, label: str, boundary: float = 1.0, **more: object) -> Column:
    """Return the column of a quantity with its interval, which is compared with a boundary."""
    return Column(name, label=label, low=f"{name}_low", high=f"{name}_high", boundary=boundary, **more)  # type: ignore[arg-type]


FITS = (
    CLASS, TARGET, PROBLEMS, Column("missed", label="missed", format="percent"),
    interval("half", "random error 0.5"), interval("tenfold", "random error 1 / 0.1"),
    interval("tenfold_bias", "bias 0.5 / 0.05"), interval("bias_over_spread", "c_b / c_s"), interval("power", "p"),
    interval("zeroth_over_first", "zeroth / first order"), interval("first_over_planted", "first order / planted"),
)  # fmt: skip
FIT_NOTES = (
    "Fit of updates = T_min (1 + c_s spread^p + c_b bias^p), with missed targets censored, and 95% intervals over problems. "
    "Random error 0.5: updates with that error over those without. Random error 1 / 0.1 and bias 0.5 / 0.05: what a factor of "
    "ten in the error is worth, in updates. c_b / c_s: bias against spread of the same size. Zeroth / first order, first order "
    "/ planted: updates at equal bias and spread. Hypotheses, classes and exclusions were written before the run, in "
    "conf/hypotheses/dose_response.md (SHA-256 {hash}).",
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the tables and charts."""
    # in small problems, several threads of linear algebra wait for each other most of the time
    with threadpool_limits(limits=1):
        return _views(experiment, rows)


def _views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    table = analysis.searches(rows)
    data = csv_table(experiment, rows)
    if table.empty or (table["kind"] == BEST).sum() == 0:
        lines = _method_lines(table) if len(table) else pd.DataFrame()
        shown = [Table("dose_response", lines, METHODS, "Methods", terminal=True, data=data)] if len(lines) else []
        return Views(shown, remarks=reasons(rows))
    lines, beside = analysis.counted(table), controls.lines(table)
    fits = list(analysis.class_fits(lines))
    costs, rates, smallest = analysis.costs(lines), analysis.wrong_rates(lines), analysis.cheapest_samples(lines)
    models = analysis.left_out(lines)
    verdicts = hypotheses(fits, costs, models, rates, smallest)
    hashes = sorted(set(rows["hypotheses"]) - {""})
    pairs = analysis.paired(lines)
    second, shapes = analysis.second_analysis(lines), analysis.shapes(lines)
    fit_lines = _fit_lines(fits)
    tables = [
        _pair_table(pairs),
        Table("dose_response", fit_lines, FITS, "Planned fit of what an error costs in updates",
              [note.format(hash=listed(hashes) if hashes else "none") for note in FIT_NOTES], page=True, data=data),
        Table("fits", fit_lines, [], files=["csv"]),
        Table("hypotheses", verdicts, [text("hypothesis"), CLASS, TARGET, text("verdict"), text("evidence"),
                                       Column("needed", label="problems needed", format="setting")], "Hypotheses", VERDICT_NOTES, page=True),
        Table("costs", costs.assign(target_name=costs["target"].map(_regret), ratio_name=costs["ratio"].map(_ratio)),
              [CLASS, TARGET, text("ratio_name", label="a gradient costs"), PROBLEMS,
               interval("share", "first order cheaper", 0.5, format="percent"),
               Column("cost_ratio", label="cost, first / zeroth order"), text("verdict", label="cheaper")],
              "Rollouts to the target, each order at its best number of samples", COST_NOTES),
        Table("models", models, [CLASS, text("model"), Column("gain", low="low", high="high"), Column("n", label="problems", format="setting")],
              "Other forms and predictors", MODEL_NOTES),
        Table("second_analysis", second, [CLASS, text("analysis"), PROBLEMS, interval("tenfold", "random error 1 / 0.1"),
                                          interval("bias_over_spread", "c_b / c_s")], "Second analysis", SECOND_NOTES),
        Table("shapes", shapes.assign(target_name=shapes["target"].map(_regret)),
              [CLASS, TARGET, PROBLEMS, interval("fixed_over_relative", "fixed size / relative"),
               interval("first_over_fixed", "first order / fixed size"), interval("zeroth_over_fixed", "zeroth order / fixed size")],
              "Updates at equal median error", SHAPE_NOTES),
        Table("methods", _method_lines(table), METHODS, "Methods at their best rate", METHOD_NOTES),
        Table("problems", _problem_lines(table), PROBLEM_COLUMNS, "Problems", PROBLEM_NOTES),
        Table("controls", rates, [text("problem"), CLASS, Column("above", label="ten times the best rate"),
                                  Column("below", label="a tenth of it")], "The best gradient with a wrong rate", RATE_NOTES),
    ]  # fmt: skip
    charts = [_chart(lines, fits, pairs, target) for target in (MAIN, 10.0, 1000.0)]
    if len(beside):  # then the question is what such methods take, and there are no planted errors
        if pairs.empty:
            tables = [table for table in tables if table.name in ("methods", "problems", "controls")]
        tables = [*controls.tables(beside), *(replace(table, terminal=False) for table in tables)]
        charts.insert(0, controls.chart(beside))
    cells = rows.assign(problem=[analysis.problem_name(row) for _, row in rows.iterrows()])
    return Views(
        tables, [chart for chart in charts if chart is not None], rows=cells,
        columns=[experiment.columns.by_name[name] for name in ("scene_class", "error", "bias", "spread", "cosine", "lowest")],
        remarks=reasons(rows),
    )  # fmt: skip


def _text(quantity: Estimate, boundary: float = 1.0) -> str:
    """Return a ratio of updates with its interval; of an infinite ratio, beyond the budget of the searches, only the lower end."""
    shown = text_of_interval(quantity.value, quantity.low, quantity.high, boundary)
    return shown if quantity.value < math.inf else f"at least {shown.partition('[')[2].partition(',')[0]}"


def _regret(target: float) -> str:
    return f"1/{target:g}"


def _predictor_name(model: str) -> str:
    return model.partition("(")[2].partition(")")[0].replace("_", " ")


def _ratio(ratio: float) -> str:
    return "measured" if math.isnan(ratio) else f"{ratio:g} rollouts"


# ---------------------------------------------------------------------------------------------------- hypotheses

VERDICT_NOTES = (
    "Confirmed or refuted where the 95% interval lies on one side as stated before the run, else open. Problems needed: number "
    "of problems at which an interval of this spread would exclude the boundary, with 80% power.",
)
COST_NOTES = (
    "Share of problems on which the first order needs fewer rollouts. Not known where its interval contains a half.",
)
PAIR_NOTES = (
    "Ratios of updates on the same problem: medians over problems with 95% intervals by order statistics, which need six problems. "
    "One size: over the best gradient. Random error 3 / 0.3, bias 0.9 / random error 1: over the second. inf: more than half miss.",
)
MODEL_NOTES = (
    "Gain: log likelihood per search on problems left out of the fit, minus that of 1 + c error^p, with the 95% interval over "
    "problems. Below 0: worse.",
)
SECOND_NOTES = ("The same quantities with Weibull times, at other targets, and from either half of the problems.",)
SHAPE_NOTES = (
    "Not planned before the run. Fixed size: planted noise relative to the gradient at the start, whose relative size grows as the "
    "gradient falls, as sampling noise does. Relative: planted noise relative to the gradient where it is added.",
)
RATE_NOTES = ("Updates to 1/100 over those at the best rate. inf: missed. Empty: not tried.",)


def hypotheses(
    fits: Sequence[ClassFit], costs: pd.DataFrame, models: pd.DataFrame, rates: pd.DataFrame, smallest: pd.DataFrame
) -> pd.DataFrame:
    """Return a line per hypothesis, class and target: its verdict, the evidence, and the problems that would decide it."""
    lines: list[dict[str, object]] = []

    def add(name: str, one: ClassFit, quantity: str, verdict: str, boundary: float) -> None:
        value = one.quantities[quantity]
        needed = value.problems_needed(boundary) if verdict == "open" else math.nan
        lines.append({
            "hypothesis": name, "scene_class": one.scene_class, "target_name": _regret(one.target), "verdict": verdict,
            "evidence": _text(value, boundary), "needed": math.ceil(needed) if math.isfinite(needed) else math.nan,
        })  # fmt: skip

    for one in fits:
        if not one.quantities:
            lines.append({"hypothesis": "all", "scene_class": one.scene_class, "target_name": _regret(one.target),
                          "verdict": "open", "evidence": f"{one.n} problems count", "needed": float(analysis.LEAST_PROBLEMS)})  # fmt: skip
            continue
        for quantity, name in (("zeroth_over_first", "1 equal error, equal updates: zeroth and first order"),
                               ("first_over_planted", "1 equal error, equal updates: first order and planted")):  # fmt: skip
            ratio = one.quantities[quantity]
            side = ratio.verdict(1 / CLOSE, CLOSE)
            verdict = {"inside": "confirmed", "open": "open"}.get(side, "refuted")
            add(name, one, quantity, verdict, CLOSE if ratio.value > 1 else 1 / CLOSE)
        ratio = one.quantities["bias_over_spread"]
        add("2 bias costs more than spread", one, "bias_over_spread",
            "confirmed" if ratio.low > 1 else "refuted" if ratio.high < 1 else "open", 1.0)  # fmt: skip
        half = one.quantities["half"]
        if one.target == 10.0:
            verdict = "confirmed" if half.high < CHEAP else "refuted" if half.low > CHEAP else "open"
            add("3 an error of 0.5 costs below 1.25", one, "half", verdict, CHEAP)
        if one.target == 1000.0:
            verdict = "confirmed" if half.low > EXPENSIVE else "refuted" if half.high < EXPENSIVE else "open"
            add("3 an error of 0.5 costs above 2", one, "half", verdict, EXPENSIVE)
    for _, model in models.iterrows():
        is_form = model["model"] in ("error^p", "no effect")
        verdict = "confirmed" if model["high"] < 0 else "refuted" if model["low"] > 0 else "open"
        against = (
            f"4 1 + c error^p against {model['model']}"
            if is_form
            else f"5 error against {_predictor_name(model['model'])}"
        )
        lines.append({"hypothesis": against, "scene_class": model["scene_class"], "target_name": _regret(MAIN), "verdict": verdict,
                      "evidence": f"gain {number(model['gain'])} [{number(model['low'])}, {number(model['high'])}]",
                      "needed": math.nan})  # fmt: skip
    for (scene_class, target), part in costs.groupby(["scene_class", "target"], sort=False):
        found_verdicts = set(part["verdict"])
        agreed = found_verdicts.pop() if len(found_verdicts) == 1 else "not known"
        evidence = ", ".join(
            f"{line['wins']} of {line['problems']} ({_ratio(line['ratio'])})" for _, line in part.iterrows()
        )
        verdict = {"first order": "confirmed", "zeroth order": "refuted"}.get(agreed, "not known")
        lines.append({"hypothesis": "6 first order cheaper in rollouts", "scene_class": scene_class,
                      "target_name": _regret(target), "verdict": verdict, "evidence": evidence, "needed": math.nan})  # fmt: skip
    for _, line in smallest.iterrows():
        verdict = "confirmed" if line["low"] > 0.5 else "refuted" if line["high"] < 0.5 else "open"
        lines.append({"hypothesis": f"6 fewest rollouts at the fewest samples, {line['kind']}", "scene_class": line["scene_class"],
                      "target_name": _regret(MAIN), "verdict": verdict, "evidence": f"{line['hits']} of {line['of']} problems",
                      "needed": math.nan})  # fmt: skip
    halves = {one.scene_class: one.quantities["half"].value for one in fits if one.target == MAIN and one.quantities}
    for scene_class, part in rates.groupby("scene_class", sort=False):
        if scene_class in halves:
            tried = part[part[["above", "below"]].notna().all(axis=1)]
            hits = int((tried[["above", "below"]].min(axis=1) > halves[scene_class]).sum())
            low, high = wilson(hits, len(tried)) if len(tried) else (0.0, 1.0)
            verdict = "confirmed" if low > 0.5 else "refuted" if high < 0.5 else "open"
            lines.append({"hypothesis": "7 a wrong rate costs more than an error of 0.5", "scene_class": scene_class,
                          "target_name": _regret(MAIN), "verdict": verdict, "evidence": f"{hits} of {len(tried)} problems",
                          "needed": math.nan})  # fmt: skip
    order = {"10": 0, "100": 1, "1000": 2}
    frame = pd.DataFrame(lines, columns=["hypothesis", "scene_class", "target_name", "verdict", "evidence", "needed"])
    keys = frame["hypothesis"].map(lambda name: (name == "all", name)).astype(str) + frame["target_name"].str[2:].map(
        order
    ).astype(str)
    return frame.iloc[keys.argsort(kind="stable")].reset_index(drop=True)


# -------------------------------------------------------------------------------------------------------- tables

METHODS = (
    CLASS, text("method"), Column("samples", format="setting"), PROBLEMS, Column("error", label="relative error"),
    Column("reached", label="reach 1/100", format="percent"), Column("relative", label="updates / best gradient's"),
    Column("over_rates", label="median over rates / best rate"), Column("tuning", label="tuning / search, updates"),
    Column("inside", label="best rate inside", format="percent"),
)  # fmt: skip
METHOD_NOTES = (
    "Medians over problems at the target 1/100, inf where most miss it. Tuning / search: updates of all searches that choose "
    "the rate, divided by the updates of one search to the target.",
)
PROBLEM_COLUMNS = (
    text("problem"), CLASS, Column("floor_10", label="1/10"), Column("floor_100", label="1/100"),
    Column("floor_1000", label="1/1000"), text("reason_100", label="left out at 1/100"),
)  # fmt: skip
PROBLEM_NOTES = (
    f"Updates of the best gradient at its best rate. A problem counts for a target if these are finite and at least {analysis.LEAST_UPDATES}.",
)


def _pair_table(pairs: pd.DataFrame) -> Table:
    """Return the table of planted errors on the same problem: a row per class and target, a column per comparison."""
    lines = []
    for (scene_class, target), part in pairs.groupby(["scene_class", "target"], sort=False):
        line = {"scene_class": scene_class, "target_name": _regret(target), "problems": part["problems"].max()}
        for row in part.itertuples():
            line |= {
                row.comparison: row.ratio,
                f"{row.comparison}_low": row.ratio_low,
                f"{row.comparison}_high": row.ratio_high,
            }
        lines.append(line)
    names = [name for name in analysis.COMPARISONS if name in set(pairs["comparison"])]
    columns = [CLASS, TARGET, PROBLEMS, *(interval(name, name) for name in names)]
    return Table(
        "pairs",
        pd.DataFrame(lines),
        columns,
        "What an error costs in updates",
        PAIR_NOTES,
        terminal=True,
        page=True,
        data=pairs,
    )


def _fit_lines(fits: Sequence[ClassFit]) -> pd.DataFrame:
    lines = []
    for one in fits:
        line: dict[str, object] = {"scene_class": one.scene_class, "target_name": _regret(one.target), "problems": one.n,
                                   "missed": one.missed}  # fmt: skip
        for name in analysis.QUANTITIES:
            value = one.quantities.get(name, Estimate(math.nan, math.nan, math.nan, one.n))
            line |= {name: value.value, f"{name}_low": value.low, f"{name}_high": value.high}
        lines.append(line)
    return pd.DataFrame(lines)


def _method_lines(table: pd.DataFrame) -> pd.DataFrame:
    part = table[(table["target"] == MAIN) & ~table["kind"].isin(analysis.PLANTED)]
    known = analysis.floors(table).query("target == @MAIN and reason == ''", local_dict={"MAIN": MAIN})
    part = part.merge(known[["problem", "floor"]], on="problem", how="left")
    updates = part["tuning_rollouts"] / part["rollouts_per_update"].where(part["rollouts_per_update"] > 0)
    updates = updates.fillna(
        part["tuning_gradients"] / part["gradients_per_update"].where(part["gradients_per_update"] > 0)
    )
    part = part.assign(
        relative=part["median"] / part["floor"], reached=np.isfinite(part["median"]),
        over_rates=part["median_over_rates"] / part["median"], tuning=updates / part["median"], problems=part["problem"],
    )  # fmt: skip
    groups = part.groupby(["scene_class", "method", "samples"], sort=False)
    columns = {name: (name, "median") for name in ("error", "relative", "over_rates", "tuning")}
    means = {name: (name, "mean") for name in ("reached", "inside")}
    return groups.agg(problems=("problems", "nunique"), **columns, **means).reset_index()


def _problem_lines(table: pd.DataFrame) -> pd.DataFrame:
    known = analysis.floors(table)
    wide = known[known["target"].isin(SHOWN)].pivot_table(
        index=["problem", "scene_class"], columns="target", values="floor", aggfunc="first", sort=False, dropna=False
    )  # fmt: skip
    wide.columns = [f"floor_{target:g}" for target in wide.columns]
    reason = known[known["target"] == MAIN].set_index("problem")["reason"]
    result = wide.reset_index()
    result = result[result["floor_100"].notna() & result["problem"].isin(reason.index)]
    return result.assign(reason_100=result["problem"].map(reason))


# --------------------------------------------------------------------------------------------------------- chart


def _chart(lines: pd.DataFrame, fits: Sequence[ClassFit], pairs: pd.DataFrame, target: float) -> Chart | None:
    """Return the cost of an error: updates over the best gradient's against the relative error, a panel per class."""
    own = [one for one in fits if one.target == target and one.quantities]
    points = analysis.relative_times(lines[lines["scene_class"].isin([one.scene_class for one in own])], target)
    if points.empty:
        return None
    natural = list(dict.fromkeys(points.loc[~points["kind"].isin(analysis.PLANTED), "method"]))
    looks = {name: Style(colour, marker, "none") for name, (colour, marker) in zip(natural, NATURAL * 9, strict=False)}
    points = points[points["error"] > 0].assign(time_low=lambda f: f["time_low"].where(f["time_low"] > 0))
    panels = [one.scene_class for one in own]
    points = points.assign(place=points["scene_class"].map(panels.index)).sort_values(
        ["place", "method"], kind="stable"
    )
    return Chart(
        "cost_of_error" if target == MAIN else f"cost_of_error_{target:g}", points,
        [Column("error", label="relative error", log=True)],
        [Column("time", label="updates / best gradient's", low="time_low", high="time_high", log=True)],
        kind="lines", series="method", panel="scene_class", styles=STYLES | looks, failed="is_missed", across=3, height=2.0,
        panel_notes={one.scene_class: f"{one.n} problems" for one in own},
        subtitle=f"To {_regret(target)} of the first regret, each method at its best rate. Cross: half of the problems miss it. "
        "A bar to the top: no upper end",
        text="Lines: planted errors. Points: natural methods, one per number of samples. Medians over problems, with 95% "
        "intervals where six problems count. The error is the median over ten thetas that all methods of a problem share.",
        on_page=True,
    )  # fmt: skip
