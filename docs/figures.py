"""Figures in the documents: each stands between two marks, and is written again from the stored results.

A document has ``<!--=name-->231<!--/-->``, where ``name`` is a reference to a stored table or to rows,
``train/windows | verdict=first | window | integer``: see :mod:`bench.report.answer`; an experiment, for its answer; or a key of
:data:`FIGURES`. Renderers hide the marks.
``python -m docs.build figures`` writes the present values, and a test fails where a document has another one.

A section whose figures come from a command that takes long has ``<!-- figures: COMMAND -->``; one whose numbers are
definitions, settings or published by others has ``<!-- figures: given -->``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
import pandas as pd
from bench.plugins.studies.bias_variance import trust
from bench.plugins.studies.gradient_check import is_trusted

from bench.model import registry
from bench.report import answer
from bench.report.text import interval as text_of_interval
from bench.report.text import number
from bench.report.text import span as ends_of
from docs.results import PAPER, STANDARD, answer_of, rows_of, table_of

MARK = re.compile(r"<!--=([\w./-]+|[^>\n]+\|.*?)-->(.*?)<!--/-->", re.DOTALL)
SOURCE = re.compile(r"<!-- figures: (.*?) -->\n?")
FOUR = ("fobg", "reinforce", "randomized_smoothing", "inverse_variance")


def span(values: Any, digits: int = 2, suffix: str = "") -> str:
    """Return the smallest and largest value, ``0.10 to 0.15``, or one number if both look the same.

    Raises LookupError if a value is missing.
    """
    if not np.size(values) or not np.all(np.isfinite(values)):
        raise LookupError(f"not finite: {values}")
    return ends_of(float(np.min(values)), float(np.max(values)), digits, suffix)


@cache
def trusted(*estimators: str) -> dict[str, str]:
    """Return the counts of the rule on the spread, see :func:`trust.counts`."""
    return {name: f"{count:,}" for name, count in trust.counts(trust.cells(STANDARD, estimators)).items()}


def trust_figure(name: str, *estimators: str) -> Callable[[], str]:
    """Return the function that gives a figure of :func:`trusted`."""
    return lambda: trusted(*estimators)[name]


def block(lines: list[str]) -> str:
    """Return lines as a block that stands between its marks on lines of their own."""
    return "\n" + "\n".join(lines) + "\n"


@cache
def speeds() -> dict[str, float]:
    """Return the lines of the stored run of ``bench_self`` by name."""
    return dict(table_of("bench_self/bench_self").set_index("what")["value"])


BATCHES = ("1000", "10000", "100000", "1e+06")
SCENES = ("pushing", "pendulum", "cartpole", "double_pendulum", "hopper")


def speed(name: str) -> list[float]:
    """Return the values of ``bench_self`` whose name, without the number of rollouts, is ``name``; ``*`` for the number."""
    return [speeds()[key] for batch in BATCHES if (key := name.replace("*", batch)) in speeds()]


def over_c(name: str) -> list[float]:
    """Return the times of a backend over those of the C loop."""
    values = speed(f"{name}, * rollouts")
    return list(np.divide(values, speed("native C kernel, * rollouts")[: len(values)]))


def rollouts_table() -> str:
    """Return microseconds of one thread per rollout by backend and batch as a Markdown table, with times over C for the same gradient."""
    lines = [
        ("C loop, gradient", "native C kernel", True),
        ("`fused` gradient", "fused grad, penalty", True),
        ("`jax` gradient", "jax grad, penalty", True),
        ("`torch` gradient", "torch grad, penalty", True),
        ("`numpy` cost", "numpy value, penalty", False),
        ("`implicit` gradient, its own law", "implicit grad, complementarity", False),
    ]
    head = [
        "| microseconds of one thread per rollout | 1,000 | 10,000 | 100,000 | 1,000,000 | times the C loop |",
        "|---" + "|--:" * 5 + "|",
    ]
    return block(
        head
        + [
            f"| {name} | "
            + " | ".join([*map(number, values), *[""] * (4 - len(values))])
            + f" | {span(over_c(what)) if is_same else ''} |"
            for name, what, is_same in lines
            for values in [speed(f"{what}, * rollouts")]
        ]
    )


def overhead_table() -> str:
    """Return the processor times of backends over those of programs written by hand as a Markdown table."""
    batches = ("1", "16", "100", "1000", "10000")
    lines = [
        "| processor time over that of a program by hand | " + " | ".join(f"{int(n):,}" for n in batches) + " |",
        "|---" + "|--:" * len(batches) + "|",
    ]
    for backend, method, what in (
        ("jax", "grad", "gradient"),
        ("torch", "grad", "gradient"),
        ("numpy", "value", "cost"),
    ):
        names = [f"{backend} {method} over by hand, {n} rollouts" for n in batches]
        lines.append(f"| `{backend}` {what} | " + " | ".join(number(speeds()[name]) for name in names) + " |")
    return block(lines)


def numbers_agree() -> str:
    """Return the largest relative difference between numbers of this package and of programs written by hand."""
    return number(max(value for name, value in speeds().items() if name.endswith("largest relative difference")))


def dose(table: str, name: str = "dose_response") -> pd.DataFrame:
    """Return a table of a study of errors as stored."""
    return pd.read_csv(STANDARD / name / f"{table}.csv", keep_default_na=True)


UPDATES = (
    "random error 0.3",
    "random error 1",
    "random error 3",
    "random error 3 / 0.3",
    "bias 0.9",
    "bias 0.9 / random error 1",
)
ROLLOUTS = "first order / zeroth order, gradient "


def dose_ratios(head: str, parts: dict[str, pd.DataFrame], names: dict[str, str]) -> str:
    """Return ratios to 1/100 as a Markdown table: a line per part, and a column per comparison, by its heading."""
    lines = [f"| {head} | scenes | {' | '.join(names)} |", f"|---|--:|{'--:|' * len(names)}"]
    for label, part in parts.items():
        rows = part.query("target == 100").set_index("comparison").reindex(list(names.values()))
        cells = [
            "-"
            if np.isnan(row.ratio)
            else number(row.ratio)
            if row.scenes < LEAST_SCENES
            else text_of_interval(row.ratio, row.ratio_low, row.ratio_high, 1.0)
            for row in rows.itertuples()
        ]
        lines.append(f"| {label} | {rows['scenes'].max():.0f} | {' | '.join(cells)} |")
    return block(lines)


LEAST_SCENES = 6
"""Fewest scenes at which the median of a ratio has an interval."""


def dose_analysis() -> Any:
    """Return the module that compares searches."""
    registry.add_folder(PAPER)
    return import_module(f"{registry.usable('studies', 'dose_response').__module__}.analysis")


def dose_classes(names: dict[str, str]) -> str:
    """Return ratios of ``dose_response`` by class as a Markdown table, and over all scenes with one value for each model."""
    analysis = dose_analysis()
    known = analysis.ratios(analysis.counted(analysis.searches(rows_of("dose_response"))))
    models = analysis.by_scene(known.assign(scene=known["scene"].str.partition("[")[0])).query(
        "scene_class == 'all classes'"
    )
    parts = dict(list(dose("pairs").groupby("scene_class", sort=False)))
    return dose_ratios("class", parts | {"all, one value a model": models}, names)


DOSE_RUNS = {
    "Adam, 20 seeds": "dose_response_seeds",
    "Adam, neural policies": "dose_response_policy",
    "plain descent": "dose_response_descent",
    "clipped descent": "dose_response_clipped",
    "L-BFGS": "dose_response_lbfgs",
}
"""What each experiment with planted errors is called in the table of their ratios."""


def dose_runs() -> str:
    """Return the ratios over all problems of each experiment with planted errors as a Markdown table."""
    parts = {label: dose("pairs", name).query("scene_class == 'all classes'") for label, name in DOSE_RUNS.items()}
    return dose_ratios("searches", parts, {name: name for name in UPDATES})


def windows_missed() -> str:
    """Return on how many problems the best gradient reaches 1/100 and a window of no length does, of how many."""
    analysis = dose_analysis()
    searches = analysis.searches(rows_of("dose_response_windows")).query("target == 100")
    medians = searches.pivot_table(index="problem", columns="method", values="median", aggfunc="first")
    missed = np.isfinite(medians[analysis.BEST]) & np.isinf(medians.filter(like="windowed")).all(axis=1)
    return f"{int(missed.sum())} of {len(medians)}"


def is_counted(problems: pd.DataFrame) -> pd.Series:
    """Return whether each problem counts for the target 1/100."""
    return problems["reason_100"].isna() | (problems["reason_100"] == "")


def dose_unreached() -> str:
    """Return on how many stiff problems that count no natural method reaches 1/100, of how many."""
    counted = int(is_counted(dose("problems").query("scene_class == 'stiff'")).sum())
    rows = dose("pairs").query("target == 100 and scene_class == 'stiff'").set_index("comparison")
    reached = rows["problems"].get(f"{ROLLOUTS}1", 0)
    return f"{counted - int(reached)} of {counted}"


def switch_verdicts(point: str) -> list[str]:
    """Return the verdicts of all checks of a robot's gradient at a point: ``before``, ``at`` or ``after`` a switch."""
    rows = rows_of("quadruped_check").query("scene == 'quadruped' and status == 'ok'")
    pairs = (zip(row["point"], row["check_verdict"], strict=True) for _, row in rows.iterrows())
    return [verdict for every in pairs for name, verdict in every if name == point]


def sides_right() -> str:
    """Return how many checks of the quadruped's gradient beside a contact switch are right, of how many."""
    verdicts = [verdict for point in ("before", "after") for verdict in switch_verdicts(point)]
    return f"{sum(is_trusted('before', verdict) for verdict in verdicts)} of {len(verdicts)}"


def jumps_at_switches() -> str:
    """Return at how many of the quadruped's contact switches the cost jumps, of how many."""
    verdicts = switch_verdicts("at")
    return f"{verdicts.count('jump')} of {len(verdicts)}"


def engines_agree() -> str:
    """Return the largest distance of MJX's gradient of the quadruped from the C engine's, relative to its norm."""
    rows = rows_of("quadruped_check")
    distances = []
    for _, part in rows.groupby("horizon"):
        mjx, mujoco = (
            np.asarray(part.loc[part["backend"].str.startswith(name), "component_program"].item(), dtype=float)
            for name in ("mjx", "mujoco")
        )
        distances.append(np.linalg.norm(mjx - mujoco) / np.linalg.norm(mujoco))
    return number(float(max(distances)))


def stability(share: str) -> Callable[[], str]:
    """Return the function that counts the cells of the stability map, all or those of a share."""

    def count() -> str:
        table = table_of("stability_map/stability_shares")
        return f"{round((table['cells'] * (1.0 if share == 'cells' else table[share])).sum()):,}"

    return count


def pairs_gain() -> str:
    """Return the least factor between the errors of independent and of mirrored draws, below the limit of the step."""
    verdicts = table_of("stiffness_sweep/verdicts").query("problem.str.startswith('pushing, penalty') and at <= 3000")
    errors = verdicts.pivot_table(index=["problem", "at"], columns="estimator", values=["error_low", "error_high"])
    return number(float((errors["error_low"]["fobg"] / errors["error_high"]["fobg[mirrored=true]"]).min()))


def effort_share() -> str:
    """Return the share of the variance of fobg that the slope of the control effort, 2 sigma w per step, has at the start."""
    rows = rows_of("stiffness_sweep").query(
        "estimator == 'fobg' and estimator_params == '' and scene == 'pushing' and contact == 'penalty' and backend == 'jax' "
        "and descent == 0 and stiffness <= 3000"
    )
    return span(100.0 * rows["dim"] * (2.0 * rows["sigma"]) ** 2 / rows["samples"] / rows["variance"], 2, "%")


MAIN = {
    "plain": "plain",
    "difference": "plain_difference",
    "fobg": "fobg",
    "pairs": "fobg[mirrored=true]",
    "reinforce": "reinforce[mirrored=true]",
    "smoothing": "randomized_smoothing",
    "orthogonal": "randomized_smoothing[draws=orthogonal]",
}
"""The estimators in README's table by the names of their figures. Numpy's differences have an error of their own beyond the limit."""
NEAR = 'stiffness_sweep/verdicts | method!="fobg (numpy)", problem="pushing, penalty, descent='
PLACES = {"start": '0", at<=3000', "later": '0.9", at<=3000', "beyond": '0", at=10000'}
UPPER = ("plain", "difference", "pairs")


SPEEDS = {
    "jax": "jax grad over by hand, 100 rollouts",
    "torch": "torch grad over by hand, 100 rollouts",
    "numpy": "numpy value over by hand, 100 rollouts",
    "sweep": "a sweep over by hand",
    "by-hand": "a sweep by hand",
    "cell": "overhead of a cell",
    "plan": "planning 10000 cells",
    "resume": "resuming 10000 stored cells",
    "list": "python -m bench list",
}
"""Lines of ``bench_self`` by the end of their figures' names."""
BEFORE = ("jax", "torch", "numpy", "sweep")
"""Those whose first stored values are figures too."""


FIGURES: dict[str, str | Callable[[], str]] = {
    **{
        f"{name}-{place}": f'{NEAR}{where}, estimator="{estimator}" | {"error_high | most" if name in UPPER and place != "beyond" else "error"}'
        for name, estimator in MAIN.items()
        for place, where in PLACES.items()
    },
    **{
        f"stability-{name.replace(' ', '-')}": stability(name)
        for name in ("cells", "wrong", "near 0", "blows up", "grew", "by step", "by law", "by both", "by unknown")
    },
    "cost-implicit-100": "stiffness_sweep_cost/bias_variance | estimator=fobg, contact=complementarity, backend=implicit, samples=100 | time_s | seconds",
    "cost-explicit-100": "stiffness_sweep_cost/bias_variance | estimator=fobg, contact=penalty, backend=jax, samples=100 | time_s | seconds",
    "cost-implicit-10000": "stiffness_sweep_cost/bias_variance | estimator=fobg, contact=complementarity, backend=implicit, samples=10000 | time_s | seconds",
    "cost-explicit-10000": "stiffness_sweep_cost/bias_variance | estimator=fobg, contact=penalty, backend=jax, samples=10000 | time_s | seconds",
    "pairs-gain": pairs_gain,
    "effort-share": effort_share,
    "quadruped-sides": sides_right,
    "quadruped-jumps": jumps_at_switches,
    "quadruped-engines": engines_agree,
    "dose-pairs": lambda: dose_classes({name: name for name in UPDATES}),
    "dose-runs": dose_runs,
    "dose-unreached": dose_unreached,
    "dose-windows-missed": windows_missed,
    "dose-hash": lambda: ", ".join(sorted(set(rows_of("dose_response")["hypotheses"]) - {""})),
    "dose-costs": lambda: dose_classes({cost: f"{ROLLOUTS}{cost}" for cost in ("1", "2", "4", "measured")}),
    **{f"trust-{name}": trust_figure(name, "fobg") for name in ("cells", "trusted", "others", "missed")},
    **{f"trust-all-{name}": trust_figure(name, *FOUR) for name in ("cells", "trusted", "wrong")},
    **{
        f"{run}-{name}": f'bench_self/{run} | what="{what}" | value'
        for name, what in SPEEDS.items()
        for run in ("before", "bench_self")[name not in BEFORE :]
    },
    "speed-rollouts": rollouts_table,
    "speed-overhead": overhead_table,
    "speed-scenes": lambda: span(
        [value for scene in SCENES for value in speed(f"fused over jax, {scene}, * rollouts")]
    ),
    "speed-bounce": lambda: span(speed("fused over jax, bounce_once, * rollouts")),
    "speed-over-c": lambda: span(over_c("fused grad, penalty")),
    "speed-agree": numbers_agree,
    "speed-memory-fused": lambda: span(speed("fused grad, penalty, * rollouts: peak memory"), 3),
    "speed-memory-jax": lambda: span(speed("jax grad, penalty, * rollouts: peak memory"), 3),
}


def with_figures(text: str) -> str:
    """Return a document with the present value of each marked figure; raises KeyError for an unknown name."""
    return MARK.sub(lambda match: f"<!--={match[1]}-->{figure(match[1])}<!--/-->", text)


def figure(name: str) -> str:
    """Return the present value of a reference to a stored table, of an experiment's answer, or of a key of :data:`FIGURES`."""
    found = FIGURES.get(name, name)
    if not isinstance(found, str):
        return found()
    return answer.value_of(found, table_of) if "|" in found else answer_of(found)


def without_marks(text: str) -> str:
    """Return a document with its figures and without the marks around them."""
    return SOURCE.sub("", MARK.sub(lambda match: match[2], text))
