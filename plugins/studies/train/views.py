"""What the study of training shows: returns by trainer, windows by length, and faults."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd

from bench.experiment.axes import table
from bench.experiment.columns import Column, interval, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Table, Views

from . import aggregate
from .verdicts import MEANINGS

PROBLEM, METHOD, VERDICT = text("problem"), text("method", label="trainer"), text("verdict")
FINAL = interval("final", label="final return", digits=3, log=False)
SUMMARY = (
    PROBLEM, METHOD, FINAL, VERDICT, Column("worst", label="worst seed", digits=3), Column("seeds", format="setting"),
    Column("failed", label="not finite", format="setting"), Column("steps", unit="steps", label="control steps", digits=3),
    Column("used", label="used steps", digits=3),
    interval("equal", label="at equal used steps", digits=3, log=False),
    Column("train_s", label="training", format="seconds"), Column("compile_s", label="compilation", format="seconds"),
    Column("gradient_typical", label="gradient norm"), Column("gradient_peak", label="largest gradient"),
    Column("cosine", label="cosine"),
)  # fmt: skip
WINDOW = Column("window", label="window", unit="steps", format="setting")
WINDOW_GRADIENT = Column("window_gradient", label="norm of the windows' gradient")
WINDOW_BIAS = interval("window_bias", label="bias of the windows' gradient")
WINDOWS = (
    PROBLEM, text("family", label="trainer"), WINDOW,
    WINDOW_GRADIENT, replace(WINDOW_BIAS, label="its bias"),
    Column("gradient_typical", label="gradient norm in training"), FINAL, VERDICT,
)  # fmt: skip
FAULTS = (
    PROBLEM,
    METHOD,
    Column("seed", format="setting"),
    text("code", label="the log shows"),
    Column("update", format="setting"),
    Column("value"),
)
COST = interval("cost", label="cost of an episode")
STEP = Column("step", label="control steps", log=False)
SEEDS = f"interquartile mean over seeds, with its 95% bootstrap interval from {aggregate.MIN_SEEDS} seeds on"
NOTE = (
    f"final return: the mean undiscounted return of the deterministic policy from the same starts, {SEEDS}. A run that is not "
    "finite counts as its untrained policy. used steps: control steps that updates use, median. at equal used steps: the return at "
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
    "verdict: first, tied (not distinguishable), behind (by a Mann-Whitney test at 5%), or open where none is behind."
)
PAGE = ("final_return", "first_return", "final_median", "updates", "steps", "train_s", "compile_s", "gradient_typical",
        "gradient_peak", "window_gradient", "window_bias")  # fmt: skip


def views(experiment: Experiment, rows: pd.DataFrame) -> Views | None:
    """Return the tables and charts of the runs; None without any."""
    runs = aggregate.runs_of(experiment, rows)
    if runs.empty:
        return None
    summary, windows, faults = aggregate.summarise(runs), aggregate.windows(runs), aggregate.faults(runs)
    summary = summary.assign(verdict=aggregate.ranked(summary, ["problem"])).drop(
        columns=["returns", *aggregate.WINDOW]
    )
    tables = [
        Table("train", summary, SUMMARY, "final return by trainer", [NOTE, VERDICTS], terminal=True, page=True, data=table(experiment, rows),
              details=["compile_s", "gradient_typical", "gradient_peak"]),
        Table("summary", summary, [], files=["csv"]),
    ]  # fmt: skip
    if len(windows):
        lines = windows.assign(verdict=aggregate.ranked(windows, ["problem", "family"])).drop(columns="returns")
        tables.append(Table("windows", lines, WINDOWS, "Windows", [WINDOW_NOTE], terminal=True, page=True,
                            details=["gradient_typical"]))  # fmt: skip
    if len(faults):
        notes = [FAULT_NOTE, *(f"- {code}: {MEANINGS[code]}" for code in faults["code"].unique())]
        tables.append(Table("faults", faults, FAULTS, "Faults in the logs", notes, page=True))
    cells = rows.assign(problem=runs["problem"], method=runs["method"]).fillna({"problem": "", "method": ""})
    by_name = experiment.columns.by_name
    return Views(tables, _charts(runs, windows), cells,
                 [METHOD, *(by_name[name] for name in PAGE)])  # fmt: skip


def _charts(runs: pd.DataFrame, windows: pd.DataFrame) -> list[Chart]:
    frame = aggregate.curves(runs)
    cost = replace(COST, log=bool((frame["cost"] > 0).all()))
    curves = Chart(
        "train", frame.dropna(subset=["step"]), [STEP], [cost], series="method", panel="problem", band=True,
        subtitle=f"cost: minus the return; {SEEDS}", text="A line per trainer, at its evaluations.",
    )  # fmt: skip
    lengths = Chart(
        "windows", windows, [replace(WINDOW, log=True)], [FINAL, WINDOW_BIAS, WINDOW_GRADIENT], series="family", panel="problem",
        subtitle=f"final return: {SEEDS}", text="A point per length of window.",
    )  # fmt: skip
    return [curves, lengths]
