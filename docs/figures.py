"""Figures in the documents: each stands between two marks, and is written again from the stored results.

A document has ``<!--=name-->231<!--/-->``, where ``name`` is a key of :data:`FIGURES`, or a reference to a stored table,
``train/windows | verdict=first | window | integer``: see :mod:`bench.report.answer`. Renderers hide the marks.
``python -m docs.build figures`` writes the present values, and a test fails where a document has another one.

A section whose figures come from a command that takes long has ``<!-- figures: COMMAND -->``; one whose numbers are
definitions, settings or published by others has ``<!-- figures: given -->``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment import config
from bench.measure.performance import wilson
from bench.model import registry
from bench.report import answer
from bench.report.text import axis_value, number
from bench.report.text import interval as text_of_interval
from bench.report.text import span as ends_of
from bench.studies.bias_variance import trust
from bench.studies.gradient_check.points import is_trusted
from bench.studies.train import aggregate
from docs.results import PAPER, STANDARD, answer_of, comparison, rmse_interval, rows_of, select, table_of

MARK = re.compile(r"<!--=([\w.-]+|[^>\n]+\|.*?)-->(.*?)<!--/-->", re.DOTALL)
SOURCE = re.compile(r"<!-- figures: (.*?) -->\n?")
FOUR = ("fobg", "reinforce", "randomized_smoothing", "inverse_variance")
SOFT, STIFF = (0.0, 3000.0), (1e4, 1e6)
"""Stiffnesses [N/m] of ``stiffness_sweep`` below and above the limit of the step."""


def span(values: Any, digits: int = 2, suffix: str = "") -> str:
    """Return the smallest and largest value, ``0.10 to 0.15``, or one number if both look the same.

    Raises LookupError if a value is missing.
    """
    if not np.size(values) or not np.all(np.isfinite(values)):
        raise LookupError(f"not finite: {values}")
    return ends_of(float(np.min(values)), float(np.max(values)), digits, suffix)


def percent(share: float) -> str:
    """Return a share as a percentage with two digits."""
    return f"{number(100 * share)}%"


def count(value: float, zero: str = "0") -> str:
    """Return a whole number with commas between thousands; ``zero`` replaces 0."""
    return f"{int(value):,}" if value else zero


def pushing(estimator: str, contact: str = "penalty", sigma: float = 0.1, **conditions: Any) -> pd.DataFrame:
    """Return rows of ``stiffness_sweep`` of an estimator with its default parameters, on compiling backends."""
    rows = select(rows_of("stiffness_sweep"), estimator=estimator, estimator_params="", contact=contact, sigma=sigma)
    backend = {"backend": "implicit" if contact == "complementarity" else "jax"}
    return select(rows, status="ok", **{**backend, **conditions})


def interval(rows: pd.DataFrame) -> str:
    """Return the relative RMSE of the only row with its 95% interval."""
    (value,), (low,), (high,) = rows["rmse_rel"], *rmse_interval(rows)
    return f"{number(value)} [{number(low)}, {number(high)}]"


def implicit_time() -> pd.Series:
    """Return the time of an implicit contact's estimate over that of the explicit contact on ``jax``, by stiffness."""
    implicit, explicit = (
        pushing("fobg", contact).set_index("stiffness")["time_s"] for contact in ("complementarity", "penalty")
    )
    return implicit / explicit


@cache
def trusted(*estimators: str) -> dict[str, Any]:
    """Return the counts of the rule on the spread: cells, trusted cells, wrong ones among both, and the worst error."""
    rows = trust.cells(STANDARD, estimators)
    keep, wrong = trust.spread(rows) < trust.SPREAD, rows["rmse_rel"] >= trust.WRONG
    worst = number(rows.loc[keep, "rmse_rel"].max())
    others, missed = (~keep).sum(), (~keep & ~wrong).sum()
    return dict(
        cells=len(rows), trusted=keep.sum(), wrong=(keep & wrong).sum(), worst=worst, others=others, missed=missed
    )


def engine(*backends: str, column: str = "rmse_rel", **conditions: Any) -> pd.Series:
    """Return a column of ``engines`` for ``fobg`` on ``pushing`` from 32 samples and 30 steps, on the backends given."""
    rows = select(
        rows_of("engines"), status="ok", scene="pushing", estimator="fobg", samples=32, horizon=30, **conditions
    )
    return rows.loc[rows["backend"].isin(backends), column]


def engine_gradient(column: str, scene: str = "bounce_once", contact: str = "penalty", **conditions: Any) -> pd.Series:
    """Return a column of ``engine_gradients`` by backend, without backends that have no value."""
    rows = select(rows_of("engine_gradients"), status="ok", scene=scene, contact=contact, **conditions)
    return rows.set_index("backend")[column].dropna()


def three_errors(**conditions: Any) -> pd.DataFrame:
    """Return the gradients of ``three_errors``, once each, although two estimators have rows of them."""
    rows = select(rows_of("three_errors"), status="ok", **conditions)
    return rows.drop_duplicates(
        ["scene", "contact", "integrator", "backend", "horizon", "dt", "stiffness", "smoothing"]
    )


def confirmed() -> pd.DataFrame:
    """Return the gradients of ``three_errors`` that agree with differences of their program to 0.1%."""
    return three_errors().query("program_error_rel < 1e-3")


def trap(**conditions: Any) -> pd.DataFrame:
    """Return ``bounce_once`` with an impulse at the step boundary, from large to small steps."""
    contact = "impulse[time_of_impact=false]"
    return three_errors(scene="bounce_once", contact=contact).sort_values("dt", ascending=False)


def stability(**conditions: Any) -> pd.DataFrame:
    """Return the rows of ``stability_map`` that were simulated."""
    return select(rows_of("stability_map").query("verdict != ''"), **conditions)


def right(scene: str, law: str = "") -> pd.Series:
    """Return the share of right cells of the stability map by integrator, for a scene at any damping, and a law."""
    rows = stability()
    rows = rows[(rows["scene"].str.partition("[")[0] == scene) & (not law or rows["contact"] == law)]
    return (rows["verdict"] == "ok").groupby(rows["integrator"]).mean()


def wrong_gradients() -> pd.DataFrame:
    """Return the rows of ``stability_map`` with a finite but wrong gradient."""
    return stability().query("verdict in ['inaccurate', 'wrong_sign', 'zero']")


def causes(stiffness: float) -> pd.Series:
    """Return the causes of wrong gradients with a penalty spring of some stiffness [N/m], at any damping."""
    rows = wrong_gradients()
    return rows[rows["contact"].str.startswith("penalty") & (rows["stiffness"] == stiffness)]["cause"]


def score(method: str, column: str = "rmse_rel", **conditions: Any) -> float:
    """Return one number of the only row of an estimator."""
    (value,) = select(rows_of(conditions.pop("experiment")), estimator=method, **conditions)[column]
    return float(value)


CONTACT, JUMP = "pushing", "heaviside"
"""The stiff contact and the jump of ``estimators``."""


def estimators(estimator: str, params: str = "", column: str = "rmse_rel", **conditions: Any) -> pd.Series:
    """Return a column of ``estimators`` for a setting, by problem or of one problem."""
    rows = select(comparison("estimators"), estimator=estimator, estimator_params=params, **conditions)
    return rows[column]


def equal_rollouts() -> pd.DataFrame:
    """Return the relative RMSE of ``equal_rollouts`` at 128 rollouts with its interval, a row per setting, by problem."""
    rows = select(rows_of("equal_rollouts"), status="ok")
    rows = rows[rows["rollouts"].round() == N_ROLLOUTS]  # the centre's rollout is shared by all repeats
    low, high = rmse_interval(rows)
    rows = rows.assign(low=low, high=high)
    settings = rows["estimator_params"].fillna("").str.replace("(.+)", r"[\1]", regex=True)
    return rows.assign(setting=rows["estimator"] + settings)


N_ROLLOUTS = 128
"""Rollouts of one estimate at which zeroth-order estimators are compared."""


def equal_rollouts_table() -> str:
    """Return the relative RMSE of zeroth-order estimators at equal rollouts as a Markdown table."""
    rows = equal_rollouts()
    scenes = list(dict.fromkeys(rows["scene"]))
    dims = rows.groupby("scene")["dim"].first()
    head = [
        "| estimator | samples | " + " | ".join(f"`{scene}`, d = {dims[scene]:.0f}" for scene in scenes) + " |",
        "|---" + "|--:" * (1 + len(scenes)) + "|",
    ]
    lines = []
    for setting, part in rows.groupby("setting", sort=False):
        errors = part.set_index("scene").loc[scenes]
        cells = [f"{number(row.rmse_rel)} [{number(row.low)}, {number(row.high)}]" for row in errors.itertuples()]
        lines.append(f"| `{setting}` | {errors['samples'].iloc[0]:.0f} | " + " | ".join(cells) + " |")
    return block(head + lines)


def equal_rollouts_reference() -> str:
    """Return the largest standard error of a reference gradient of ``equal_rollouts``, and its scene."""
    rows = equal_rollouts()
    errors = (rows["reference_se"] / rows["reference_norm"]).groupby(rows["scene"]).max()
    return f"{percent(errors.max())} of the norm on `{errors.idxmax()}`"


def backward_memory() -> pd.DataFrame:
    """Return memory and time of each method of ``backward_memory`` at its longest horizon, the first scene first."""
    return pd.read_csv(STANDARD / "backward_memory" / "backward_memory_methods.csv")


def backward_memory_table() -> str:
    """Return memory, its growth and time of a long backward pass by method and scene as a Markdown table."""
    lines = backward_memory()
    scenes = list(dict.fromkeys(lines["problem"]))
    head = [
        "| backend | " + " | ".join(f"`{scene}`: MiB | p | seconds" for scene in scenes) + " |",
        "|---" + "|--:" * (3 * len(scenes)) + "|",
    ]
    return block(head + [
        f"| `{method}` | " + " | ".join(
            f"{backward_memory_of(row)} | {with_ends(row, 'order') if np.isfinite(row['order']) else '-'} | {number(row['gradient_s'])}"
            for _, row in part.set_index("problem").loc[scenes].iterrows()
        ) + " |"
        for method, part in lines.groupby("method", sort=False)
    ])  # fmt: skip


def with_ends(row: Any, name: str, digits: int = 2) -> str:
    """Return a number with the ends of its interval, or without one where that is not known."""
    value, low, high = (number(row[f"{name}{end}"], digits) for end in ("", "_low", "_high"))
    return f"{value} [{low}, {high}]" if np.isfinite(row[f"{name}_low"]) else value


def backward_memory_of(row: pd.Series) -> str:
    """Return the memory of a method with its interval, or its upper limit."""
    return f"< {number(row['memory_mb_high'])}" if row["is_small"] else with_ends(row, "memory_mb")


def windows(params: str, scene: str = "") -> pd.DataFrame:
    """Return the supported rows of ``windows`` whose windows are shorter than the horizon, with some terminal value."""
    rows = rows_of("windows")
    keep = rows["estimator_params"].str.endswith(params) & (rows["estimator"] == "windowed")
    keep &= (rows["status"] == "ok") & rows["scene"].str.startswith(scene) & (rows["steps"] < rows["horizon"])
    return rows[keep]


def short_windows() -> pd.DataFrame:
    """Return the rows of ``windows`` without a terminal value and with windows of up to half the horizon."""
    rows = windows("")
    return rows[~rows["estimator_params"].str.contains("terminal") & (rows["steps"] <= rows["horizon"] / 2)]


def window_lqr() -> str:
    """Return how the error of a learned terminal value falls with the length of the window, on ``lqr``."""
    rows = windows("learned", "lqr").sort_values("steps").iloc[[0, -1]]
    (first, last), (short, long) = (number(value) for value in rows["rmse_rel"]), rows["steps"]
    return f"{first} at {short:.0f} step to {last} at {long:.0f}"


def learning_rates() -> pd.DataFrame:
    """Return the score of each method over the learning rates, the best first."""
    return pd.read_csv(STANDARD / "learning_rates" / "summary.csv").sort_values("score", ascending=False)


def learning_rates_table() -> str:
    """Return the scores of ``learning_rates`` as a Markdown table."""
    rows = [
        f"| {row.method} | {row.score:.3f} [{row.score_low:.3f}, {row.score_high:.3f}] | {number(float(row.median_score))} |"
        for row in learning_rates().itertuples()
    ]
    head = ["| method | score at its best rate on each problem | median over the rates |", "|---|--:|--:|"]
    return block([*head, *rows])


def block(lines: list[str]) -> str:
    """Return lines as a block that stands between its marks on lines of their own."""
    return "\n" + "\n".join(lines) + "\n"


def fits(column: str, integrator: str, methods: tuple[int, ...], scene: str = "mass_spring_damper") -> np.ndarray:
    """Return a number of each case of ``identify`` for methods of shooting: 0 single, 1 multiple, 2 windows."""
    rows = rows_of("identify")
    rows = rows[rows["scene"].str.startswith(scene) & (rows["integrator"] == integrator)]
    values = np.array([values[method] for values in rows[column] for method in methods], dtype=float)
    return np.asarray(values[np.isfinite(values)])


def hidden() -> str:
    """Return how many fits of ``identify`` had more identifiable directions than the record, of how many."""
    rows = rows_of("identify")
    known = [np.isfinite(np.array(values, dtype=float)) for values in rows["hidden"]]
    total = sum(fits * keep.sum() for fits, keep in zip(rows["fits"], known, strict=True))
    return f"{count(sum(np.sum(values) for values in rows['hidden']))} of {count(total)}"


@cache
def trained(experiment: str = "train") -> pd.DataFrame:
    """Return the runs of an experiment with the study ``train``, with the problem and the method of each."""
    loaded = config.load([f"experiment={experiment}"])
    return aggregate.runs_of(loaded, rows_of(loaded.name))


def trained_in_range(low: float, high: float) -> str:
    """Return how many runs of ``shac`` with the public settings end with a mean return in a range, of how many."""
    final = trained().query("method == 'shac'")["final_return"]
    return f"{((low <= final) & (final <= high)).sum()} of {len(final)}"


def window_bias(line: dict[str, Any]) -> str:
    """Return the bias of windows with its interval, or the upper end of an interval that reaches 0."""
    low, high = number(line["window_bias_low"]), number(line["window_bias_high"])
    return f"{number(line['window_bias'])} [{low}, {high}]" if line["window_bias_low"] > 0 else f"0 (< {high})"


def trained_table(experiment: str = "train") -> str:
    """Return the final return, steps and times by trainer as a Markdown table, and the return at equal used steps if some are not."""
    lines = aggregate.summarise(trained(experiment)).to_dict("records")
    has_unused = any(line["used"] < line["steps"] for line in lines)
    more = " used steps | at equal used steps |" * has_unused
    head = f"| trainer | final return | worst seed | control steps |{more} training | compilation |"
    return block([head, "|---" + "|--:" * (5 + 2 * has_unused) + "|"] + [
        f"| `{line['method']}` | {with_ends(line, 'final', 3)} | {number(line['worst'], 3)} | {count(line['steps'])} |"
        + f" {count(round(line['used'], -3))} | {with_ends(line, 'equal', 3)} |" * has_unused
        + f" {number(line['train_s'])} s | {number(line['compile_s'])} s |"
        for line in lines
    ])  # fmt: skip


def windows_table(experiment: str = "train") -> str:
    """Return gradient and final return by the length of a window as a Markdown table; on the cart-pole also the bias."""
    has_bias = experiment == "train"
    head = f"| window [steps] | norm of the gradient |{' its bias |' * has_bias} final return |"
    return block([head, "|--:" * (3 + has_bias) + "|"] + [
        f"| {line['window']:.0f} | {number(line['window_gradient'])} |{f' {window_bias(line)} |' * has_bias} {with_ends(line, 'final', 3)} |"
        for line in aggregate.windows(trained(experiment)).to_dict("records")
    ])  # fmt: skip


def stiffness_table() -> str:
    """Return gradient and final return by the stiffness of the ground and the length of a window, as Markdown."""
    head = ["| stiffness [N/m] | window [steps] | norm of the gradient | final return |", "|--:" * 4 + "|"]
    return block(head + [
        f"| {count(stiffness)} | {line['window']:.0f} | {number(line['window_gradient'])} | {with_ends(line, 'final', 3)} |"
        for stiffness, part in trained("train/stiffness").groupby("stiffness")
        for line in aggregate.windows(part).to_dict("records")
    ])  # fmt: skip


def gradient_norms(experiment: str, window: int) -> str:
    """Return the range over seeds of the median norm of a run's gradients, for ``shac`` with one length of window."""
    runs = trained(experiment)
    return span(runs.loc[runs["trainer"].str.contains(f"window={window}]", regex=False), "gradient_typical"])


def faults_table() -> str:
    """Return per trainer and fault the number of half-cheetahs whose log shows it, and the numbers of the first, as Markdown."""
    runs = trained("train/half_cheetah")
    seeds = runs.groupby("method")["seed"].nunique()
    faults, numbers = aggregate.faults(runs), ["update", "value"]
    head = ["trainer", "fault", "runs", "first in seed", *numbers]
    return block([f"| {' | '.join(head)} |", "|---|---|" + "--:|" * (len(head) - 2)] + [
        f"| `{method}` | {code.replace('_', ' ')} | {len(part)} of {seeds[method]} | {part['seed'].iloc[0]:.0f} | "
        + " | ".join(axis_value(float(f"{part[name].iloc[0]:.3g}")) for name in numbers) + " |"
        for (method, code), part in faults.groupby(["method", "code"])
    ])  # fmt: skip


@cache
def speeds() -> dict[str, float]:
    """Return the lines of the stored run of ``bench_self`` by name."""
    lines = json.loads((STANDARD / "bench_self" / "bench_self.json").read_text())["lines"]
    return {line["what"]: line["value"] for line in lines if line["value"] is not None}


BATCHES = ("1000", "10000", "100000", "1e+06")


def speed(name: str) -> list[float]:
    """Return the values of ``bench_self`` whose name, without the number of rollouts, is ``name``; ``*`` for the number."""
    return [speeds()[key] for batch in BATCHES if (key := name.replace("*", batch)) in speeds()]


def rollouts_table() -> str:
    """Return microseconds per rollout by backend and batch as a Markdown table."""
    c = speed("native C kernel, one thread, * rollouts")
    lines = [
        ("`fused` gradient", "0.6", speed("fused grad, penalty, * rollouts")),
        ("`jax` gradient", "1.2", speed("jax grad, penalty, * rollouts")),
        ("`implicit` gradient", "6", speed("implicit grad, complementarity, * rollouts")),
        ("`torch` gradient", "25", speed("torch grad, penalty, * rollouts")),
        ("`numpy` cost", "8", speed("numpy value, penalty, * rollouts")),
        ("plain NumPy loop, gradient", "", speed("plain NumPy loop with its adjoint, * rollouts")),
        ("C loop, gradient", "", c),
    ]
    head = [
        "| microseconds per rollout | target | 1,000 | 10,000 | 100,000 | 1,000,000 | times the C loop |",
        "|---" + "|--:" * 6 + "|",
    ]
    return block(head + [
        f"| {name} | {target} | " + " | ".join([*map(number, values), *[""] * (4 - len(values))])
        + f" | {span(np.divide(values, c[: len(values)]))} |"
        for name, target, values in lines
    ])  # fmt: skip


def scenes_table() -> str:
    """Return the time of ``fused`` over that of ``jax`` by scene as a Markdown table."""
    scenes = ("pushing", "pendulum", "cartpole", "double_pendulum", "hopper", "bounce_once")
    head = ["| gradient, `fused` over `jax` on the same cores (target 0.33) | 1,000 | 100,000 |", "|---|--:|--:|"]
    ratios = {scene: speed(f"fused over jax, {scene}, * rollouts") for scene in scenes}
    return block(head + [f"| {scene} | " + " | ".join(map(number, values)) + " |" for scene, values in ratios.items()])


def gpu_table() -> str:
    """Return gradients per second, their agreement with the CPU and compile time by case and precision as Markdown."""
    rows = pd.read_csv(STANDARD / "gpu" / "gpu.csv")
    keys = ["case", "backend", "dtype"]
    rates = rows.pivot(index=keys, columns="batch", values="gradients_per_s")[[1, 1024, 16384]]
    most = rows.groupby(keys)[["agreement", "compile_s"]].max()
    head = [
        "| scene | backend | precision | 1 | 1,024 | 16,384 | agreement | compiles [s] |",
        "|---|---|---|--:|--:|--:|--:|--:|",
    ]
    return block(head + [
        f"| {case} | `{backend}` | {dtype} | " + " | ".join(map(number, [*rates.loc[key], *most.loc[key]])) + " |"
        for key in rows[keys].drop_duplicates().itertuples(index=False, name=None)
        for case, backend, dtype in [key]
    ])  # fmt: skip


def dose(table: str, name: str = "dose_response") -> pd.DataFrame:
    """Return a table of a study of errors as stored."""
    return pd.read_csv(STANDARD / name / f"{table}.csv", keep_default_na=True)


UPDATES = (
    "random error 0.3", "random error 1", "random error 3", "random error 3 / 0.3", "bias 0.6", "bias 0.9", "bias 0.9 / random error 1",
)  # fmt: skip
ROLLOUTS = "first order / zeroth order, gradient "


def dose_ratios(head: str, parts: dict[str, pd.DataFrame], names: dict[str, str]) -> str:
    """Return ratios to 1/100 as a Markdown table: a line per part, and a column per comparison, by its heading."""
    lines = [f"| {head} | problems | scenes | {' | '.join(names)} |", f"|---|--:|--:|{'--:|' * len(names)}"]
    for label, part in parts.items():
        rows = part.query("target == 100").set_index("comparison").reindex(list(names.values()))
        cells = [
            "-" if np.isnan(row.ratio) else number(row.ratio) if row.scenes < LEAST_SCENES else
            text_of_interval(row.ratio, row.ratio_low, row.ratio_high, 1.0) for row in rows.itertuples()
        ]  # fmt: skip
        lines.append(f"| {label} | {rows['problems'].max():.0f} | {rows['scenes'].max():.0f} | {' | '.join(cells)} |")
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
    "Adam": "dose_response",
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
    return dose_ratios("searches", parts, {name: name for name in UPDATES if name != "bias 0.6"})


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


def mjx_solver(column: str) -> pd.Series:
    """Return a column of the rows of MJX in ``solver_iterations``, by iterations."""
    rows = rows_of("solver_iterations")
    rows = rows[rows["backend"].str.startswith("mjx") & (rows["status"] == "ok")]
    return rows.set_index("iterations")[column]


def mjx_solver_compile() -> str:
    """Return the compile times of the gradients of MJX."""
    seconds = mjx_solver("compile_s")
    return f"{seconds.min():.0f} to {seconds.max():.0f} s"


def mjx_solver_error() -> str:
    """Return the largest error of MJX's gradients with 2 iterations or more, relative to the converged program's."""
    errors = mjx_solver("gradient_error_rel")
    return number(errors[errors.index > 1].max())


def quadruped_growth(horizon: float) -> str:
    """Return the median norm of the quadruped's gradient at a horizon, with 5% to 95% of the samples."""
    row = select(rows_of("quadruped_growth"), horizon=horizon).iloc[0]
    low, median, high = (number(row[f"gradient_{name}"]) for name in ("low", "median", "high"))
    return f"{median} [{low}, {high}]"


def switch_verdicts(point: str, folder: str = "quadruped_check") -> list[str]:
    """Return the verdicts of all checks of a robot's gradient at a point: ``before``, ``at`` or ``after`` a switch."""
    rows = select(rows_of(folder), scene="quadruped", status="ok")
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


PUSH = {
    "apart, noise 0.02": {"lean": 0.0, "sigma": 0.02},
    "apart, noise 0.2": {"lean": 0.0, "sigma": 0.2},
    "in contact, noise 0.02": {"lean": 0.2, "sigma": 0.02},
}
"""The problems of ``push``: whether the first plan touches the block, and the noise [rad]."""
PUSHED = 0.1
"""Cost at which the block counts as pushed: it is within a third of the way from its target."""


def pushes() -> pd.DataFrame:
    """Return the searches of ``push`` with their problem, method, first rollouts below :data:`PUSHED`, and if they touch.

    Without contact the cost is at least 1, so that a search with a lower cost on its path has touched.
    """
    rows = select(rows_of("push"), status="ok")
    lean = [json.loads(text)["scene"]["lean"] for text in rows["parameters"]]
    weight = [json.loads(text)["study"]["gradient_cost"] for text in rows["parameters"]]
    rows = rows.assign(lean=lean, weight=weight, method=[
        ", ".join(filter(None, (row.estimator, row.optimizer.partition("[")[0]))) for row in rows.itertuples()
    ])  # fmt: skip
    for problem, values in PUSH.items():
        rows.loc[select(rows, **values).index, "problem"] = problem
    spent = [
        next((r + row.weight * g for c, r, g in zip(row.path_cost, row.path_rollouts, row.path_gradients, strict=True) if c < PUSHED), np.inf)
        for row in rows.itertuples()
    ]  # fmt: skip
    return rows.assign(touched=rows["best_cost"] < 1.0, spent=spent)


def share_touched(problem: str, *methods: str, pushed: bool = False) -> str:
    """Return how many searches of the methods touched the block, or ``pushed`` it, of how many, with a 95% interval."""
    rows = pushes()
    rows = rows[(rows["problem"] == problem) & rows["method"].isin(methods)]
    counted = np.isfinite(rows["spent"]) if pushed else rows["touched"]
    low, high = wilson(int(counted.sum()), len(counted))
    return f"{counted.sum()} of {len(counted)} [{low:.0%}, {high:.0%}]"


def push_table() -> str:
    """Return by method and problem how many searches touch and push the block, and after how many rollouts, as a table."""
    rows, head = pushes(), ["| method | " + " | ".join(PUSH) + " |", "|---" + "|---" * len(PUSH) + "|"]
    lines = []
    for method in dict.fromkeys(rows.sort_values("method")["method"]):
        cells = []
        for problem in PUSH:
            part = rows[(rows["problem"] == problem) & (rows["method"] == method)]
            pushed = sorted({f"{spent:.0f}" for spent in part["spent"] if np.isfinite(spent)}, key=float)
            after = f", after {' to '.join(dict.fromkeys([pushed[0], pushed[-1]]))}" if pushed else ""
            counts = (part["touched"].sum(), np.isfinite(part["spent"]).sum())
            cells.append(f"{counts[0]} touch, {counts[1]} push{after}")
        lines.append(f"| `{method.replace(', ', '`, `')}` | {' | '.join(cells)} |")
    return block([*head, *lines])


def push_costs(problem: str, *methods: str, digits: int = 3) -> str:
    """Return the lowest and highest final cost of the methods' searches."""
    rows = pushes()
    return span(rows.loc[(rows["problem"] == problem) & rows["method"].isin(methods), "final_cost"], digits)


FIGURES: dict[str, Callable[[], str]] = {
    "mjx-solver-compile": mjx_solver_compile,
    "mjx-solver-error": mjx_solver_error,
    "quadruped-sides": sides_right,
    "quadruped-jumps": jumps_at_switches,
    "quadruped-jump-share": lambda: span(100 * rows_of("quadruped_check")["jump_share"], suffix="%"),
    "quadruped-norm-10": lambda: quadruped_growth(10),
    "quadruped-norm-100": lambda: quadruped_growth(100),
    "quadruped-engines": engines_agree,
    "push-still": lambda: share_touched("apart, noise 0.02", "fobg, adam", "fobg, lbfgs"),
    "push-noisy": lambda: share_touched("apart, noise 0.2", "fobg, adam", "randomized_smoothing, adam"),
    "push-search": lambda: share_touched("apart, noise 0.02", "cma_es", "cem"),
    "push-near": lambda: share_touched("in contact, noise 0.02", "fobg, adam", "fobg, lbfgs", pushed=True),
    "push-table": push_table,
    "push-on-lbfgs": lambda: span(select(rows_of("push_on"), optimizer="lbfgs")["final_cost"], digits=3),
    "push-on-cem": lambda: push_costs("apart, noise 0.02", "cem"),
    "dose-answer": lambda: answer_of("dose_response"),
    "dose-pairs": lambda: dose_classes({name: name for name in UPDATES}),
    "dose-runs": dose_runs,
    "dose-unreached": dose_unreached,
    "dose-windows-missed": windows_missed,
    "dose-hash": lambda: ", ".join(sorted(set(rows_of("dose_response")["hypotheses"]) - {""})),
    "dose-costs": lambda: dose_classes({cost: f"{ROLLOUTS}{cost}" for cost in ("1", "2", "4", "measured")}),
    "fobg-soft": lambda: span(pushing("fobg", stiffness=SOFT)["rmse_rel"]),
    "reinforce-soft": lambda: span(pushing("reinforce", stiffness=SOFT)["rmse_rel"]),
    "fobg-stiff": lambda: interval(pushing("fobg", stiffness=1e4)),
    "smoothing-stiff": lambda: span(pushing("randomized_smoothing", stiffness=STIFF)["rmse_rel"]),
    "fobg-implicit-stiff": lambda: span(pushing("fobg", "complementarity", stiffness=STIFF)["rmse_rel"]),
    "implicit-time": lambda: span(implicit_time()),
    "trust-cells": lambda: count(trusted("fobg")["cells"]),
    "trust-trusted": lambda: count(trusted("fobg")["trusted"]),
    "trust-worst": lambda: str(trusted("fobg")["worst"]),
    "trust-others": lambda: count(trusted("fobg")["others"]),
    "trust-missed": lambda: count(trusted("fobg")["missed"], "none"),
    "trust-all-cells": lambda: count(trusted(*FOUR)["cells"]),
    "trust-all-trusted": lambda: count(trusted(*FOUR)["trusted"]),
    "trust-all-wrong": lambda: count(trusted(*FOUR)["wrong"]),
    "trust-all-worst": lambda: str(trusted(*FOUR)["worst"]),
    "heaviside-fobg": lambda: number(score("fobg", experiment="quick", scene="heaviside", backend="jax")),
    "heaviside-smoothing": lambda: number(
        score("randomized_smoothing", experiment="quick", scene="heaviside", backend="jax")
    ),
    "pushing-16": lambda: number(
        score("fobg", experiment="speed_accuracy", scene="pushing", backend="jax", samples=16)
    ),
    "engines-soft": lambda: span(engine("jax", "implicit", "mujoco", "mjx", stiffness=(1e2, 1e3))),
    **{
        f"engines-stiff-{name}": lambda name=name: count(float(number(engine(name, stiffness=1e4).max(), 3)))  # type: ignore[misc]
        for name in ("jax", "mujoco", "mjx")
    },
    "engines-ms-minimal": lambda: span(1e3 * engine("jax", "implicit", column="time_s")),
    **{
        f"engines-ms-{name}": lambda name=name: span(1e3 * engine(name, column="time_s"))  # type: ignore[misc]
        for name in ("mjx", "mujoco")
    },
    "eg-bounce": lambda: span(engine_gradient("rmse_rel").drop("drake")),
    "eg-bounce-drake": lambda: number(engine_gradient("rmse_rel", backend="drake").item()),
    "eg-bounce-costs": lambda: span(engine_gradient("zeroth_rmse_rel")),
    "eg-pipe-bounce": lambda: span(100 * engine_gradient("pipe_share"), suffix="%"),
    "eg-pipe-cartpole": lambda: span(100 * engine_gradient("pipe_share", "cartpole", "none"), suffix="%"),
    "three-confirmed": lambda: count(len(confirmed())),
    "three-missed": lambda: count((confirmed()["model_error_rel"] > 0.1).sum()),
    "trap-program": lambda: number(trap()["program_error_rel"].max()),
    "trap-forward": lambda: " to ".join(percent(value) for value in trap()["forward_error_rel"].iloc[[0, -1]]),
    "trap-cosine": lambda: span(trap()["model_cosine"]),
    "stability-cells": lambda: count(len(stability())),
    "stability-wrong": lambda: count(len(wrong_gradients())),
    "stability-diverged": lambda: count(stability()["verdict"].isin(["diverged", "nonfinite"]).sum()),
    "spring-rk4": lambda: percent(right("mass_spring")["rk4"]),
    "spring-implicit": lambda: percent(right("mass_spring")["implicit_euler"]),
    "ball-event": lambda: percent(right("bouncing_ball", "impulse")["event_driven"]),
    "clip-90": lambda: span(estimators("clipped", scene=CONTACT)),
    "clip-50": lambda: span(estimators("clipped", "quantile=0.5", scene=CONTACT)),
    "difference-short": lambda: span(estimators("finite_difference", scene=CONTACT)),
    "difference-long": lambda: span(estimators("finite_difference", "step=0.1", scene=CONTACT)),
    "weights-contact": lambda: span(estimators("total_propagation", "per=action", scene=CONTACT)),
    "weights-jump": lambda: span(estimators("total_propagation", scene=JUMP)),
    "equal-rollouts": equal_rollouts_table,
    "equal-rollouts-reference": equal_rollouts_reference,
    "backward-memory": backward_memory_table,
    "measure-samples": lambda: count(estimators("measure_valued", column="best").sum()),
    "window-bias": lambda: number(short_windows()["bias_rel"].min()),
    "window-learned": lambda: f"{(windows('learned')['bias_low'] == 0).sum()} of {len(windows('learned'))}",
    "window-lqr": window_lqr,
    "learning-rates": learning_rates_table,
    "rate-effect": lambda: span((rates := learning_rates())["score"] - rates["median_score"]),
    "rate-methods": lambda: number(float(np.ptp(learning_rates()["score"]))),
    "train-answer": lambda: answer_of("train"),
    "train-range": lambda: trained_in_range(-560.0, -480.0),
    "train-table": trained_table,
    "train-windows": windows_table,
    "hopper-answer": lambda: answer_of("train/hopper"),
    "hopper-table": lambda: trained_table("train/hopper"),
    "hopper-stiffness": stiffness_table,
    "hopper-windows": lambda: windows_table("train/hopper"),
    "cheetah-answer": lambda: answer_of("train/half_cheetah"),
    "cheetah-table": lambda: trained_table("train/half_cheetah"),
    "cheetah-norms-8": lambda: gradient_norms("train/half_cheetah", 8),
    "cheetah-norms-16": lambda: gradient_norms("train/half_cheetah", 16),
    "cheetah-faults": faults_table,
    "fits-hidden": hidden,
    "fits-bound": lambda: span(fits("error", "rk4", (0, 1))),
    "fits-coverage": lambda: span(100 * fits("coverage", "rk4", (0, 1)), suffix="%"),
    "fits-windows": lambda: span(fits("error", "rk4", (2,))),
    "fits-sliding": lambda: percent(fits("coverage", "semi_implicit_euler", (0,), "sliding_block").min()),
    "speed-fused": lambda: span(speed("fused grad, penalty, * rollouts")),
    "speed-jax": lambda: span(speed("jax grad, penalty, * rollouts")),
    "speed-cell": lambda: number(speeds()["overhead of a cell"]),
    "speed-rollouts": rollouts_table,
    "speed-scenes": scenes_table,
    "speed-gpu": gpu_table,
    "speed-one-thread": lambda: span(speed("fused on one thread over the C kernel, * rollouts")),
    "speed-agree": lambda: number(speeds()["native C kernel: largest relative difference"]),
    "speed-memory-fused": lambda: span(speed("fused grad, penalty, * rollouts: peak memory"), 3),
    "speed-memory-jax": lambda: span(speed("jax grad, penalty, * rollouts: peak memory"), 3),
    "speed-compilations": lambda: count(speeds()["compilations over 27 values of stiffness x beta x sigma"]),
    "speed-plan": lambda: number(speeds()["planning 10000 cells"]),
    "speed-resume": lambda: number(speeds()["resuming 10000 stored cells"]),
    "speed-list": lambda: number(speeds()["python -m bench list"]),
    "soft-law": lambda: f"{(causes(100) == 'law').sum()} of {len(causes(100))}",
    "stiff-step": lambda: f"{(causes(1e4) == 'step').sum()} of {len(causes(1e4))}",
    "stiff-both": lambda: count((causes(1e4) == "both").sum()),
    **{
        f"cause-{cause}": lambda cause=cause: count((wrong_gradients()["cause"] == cause).sum())  # type: ignore[misc]
        for cause in ("step", "law", "both", "unknown")
    },
}


def with_figures(text: str) -> str:
    """Return a document with the present value of each marked figure; raises KeyError for an unknown name."""
    return MARK.sub(lambda match: f"<!--={match[1]}-->{figure(match[1])}<!--/-->", text)


def figure(name: str) -> str:
    """Return the present value of a figure, by its name or as a reference to a stored table."""
    return answer.value_of(name, table_of) if "|" in name else FIGURES[name]()


def without_marks(text: str) -> str:
    """Return a document with its figures and without the marks around them."""
    return SOURCE.sub("", MARK.sub(lambda match: match[2], text))
