"""Ranks estimators within each problem: a table of relative errors with intervals, one column per problem."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd

from bench.experiment.experiment import Experiment
from bench.report.tables import csv, plain_markdown
from bench.report.text import number
from bench.report.views import estimator_labels
from bench.run.files import write_all

LEAST = 3
"""Fewest estimators for which the ranking is written; the main table is enough for fewer."""
WORTHLESS = 0.99
"""Relative RMSE at and above which an estimate counts as no better than the zero estimate."""
MANY = 2.5
"""The number of evaluations per sample is printed above this value."""
WINS, FAILS, BIASED = "wins", "fails", "biased"


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``ranking`` (.md, .csv) if :func:`rank_estimators` has rows; return the files' paths."""
    table = rank_estimators(rows)
    if table.empty:
        return []
    texts = pd.DataFrame(
        {"estimator": list(dict.fromkeys(table["label"]))}
        | {problem: _column(table, problem) for problem in dict.fromkeys(table["problem"])}
    )
    legend = (
        "\n\nRelative RMSE [95% interval] at equal samples, not at equal rollouts. *wins*: not distinguishable from the lowest "
        "of its column. *fails*: no better than the zero estimate. *biased*: more than half of the error is bias. *(40x)*: it "
        "evaluates 40 costs and gradients per sample, where others take one or two.\n"
    )
    contents = {"ranking.md": plain_markdown(texts) + legend + _best_text(best(table)), "ranking.csv": csv(table)}
    return write_all(experiment.directory, contents)


def best(table: pd.DataFrame) -> pd.DataFrame:
    """Return, per estimator and problem, the setting with the lowest error at equal evaluations, and its verdict.

    At one evaluation (cost or gradient) per sample, an estimate has the measured bias, and the measured variance times
    the estimator's evaluations per sample. Choosing the best of several settings favours an estimator by about the
    width of its interval.
    """
    good = table[(table["status"] == "ok") & np.isfinite(table["equal"])]
    good = good.assign(estimator=good["label"].str.partition("[")[0])
    if good.empty:
        return good
    chosen = good.loc[good.groupby(["estimator", "problem"], sort=False)["equal"].idxmin()]
    lowest = chosen.groupby("problem")["equal_high"].min()
    wins = chosen["equal_low"].to_numpy() <= lowest.reindex(chosen["problem"]).to_numpy()
    verdict = np.select([chosen["equal"] >= WORTHLESS, wins], [FAILS, WINS], "")
    return chosen.assign(verdict=verdict).reset_index(drop=True)


def _best_text(table: pd.DataFrame) -> str:
    """Format each estimator's best setting on each problem; empty unless some estimator has parameters."""
    if table.empty or not table["label"].str.contains("[", regex=False).any():
        return ""
    texts = {
        (row.estimator, row.problem): f"{number(row.equal)} [{number(row.equal_low)}, {number(row.equal_high)}]"
        + (f" {row.verdict}" if row.verdict else "")
        + (f" ({row.label.partition('[')[2][:-1]})" if "[" in row.label else "")
        for row in table.itertuples()
    }
    names, problems = dict.fromkeys(table["estimator"]), dict.fromkeys(table["problem"])
    wide = pd.DataFrame(
        {"estimator": list(names)} | {p: [texts.get((name, p), "") for name in names] for p in problems}
    )
    return (
        "\nEach estimator at its best setting (in parentheses), and at equal work: relative RMSE of an estimate of as many "
        "costs and gradients together as there are samples, from the measured bias and variance. The words mean the same as above.\n\n"
        + plain_markdown(wide)
        + "\n"
    )


def _column(table: pd.DataFrame, problem: str) -> list[str]:
    part = table[table["problem"] == problem].set_index("label")
    return [part["text"].get(label, "") for label in dict.fromkeys(table["label"])]


def rank_estimators(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one row per cell: estimator, problem, relative RMSE with its interval, and its verdict.

    The table is empty unless at least three estimators ran on several problems, once per problem. The interval combines
    the intervals of bias and variance, since rmse^2 = bias^2 + variance.
    """
    rows = rows.assign(
        label=estimator_labels(rows),
        problem=np.where(rows["contact"] == "none", rows["scene"], rows["scene"] + ", " + rows["contact"]),
    )
    once = not rows.duplicated(["label", "problem"]).any()
    if not once or rows["label"].nunique() < LEAST or rows["problem"].nunique() < 2:
        return pd.DataFrame()
    norm = rows["reference_norm"]
    low = np.sqrt(rows["bias_low"] ** 2 + rows["variance_low"]) / norm
    high = np.sqrt(rows["bias_high"] ** 2 + rows["variance_high"]) / norm
    table = rows[["label", "problem", "status", "rmse_rel", "rollouts", "gradients"]].assign(
        low=low, high=high, share=(rows["bias_low"] / rows["rmse"]) ** 2,
        evaluations=(work := (rows["rollouts"] + rows["gradients"]) / rows["samples"]),
        equal=np.sqrt(rows["bias"] ** 2 + rows["variance"] * work) / norm,
        equal_low=np.sqrt(rows["bias_low"] ** 2 + rows["variance_low"] * work) / norm,
        equal_high=np.sqrt(rows["bias_high"] ** 2 + rows["variance_high"] * work) / norm,
    )  # fmt: skip
    good = table["status"] == "ok"
    lowest = table[good].groupby("problem")["high"].min()
    table["verdict"] = [_verdict(row, lowest.get(row.problem, math.nan)) for row in table.itertuples()]
    table["text"] = [_text(row) for row in table.itertuples()]
    return table.reset_index(drop=True)


def _verdict(row: object, lowest: float) -> str:
    status, low, share, rmse = (getattr(row, name) for name in ("status", "low", "share", "rmse_rel"))
    if status != "ok":
        return str(status)
    wins = low <= lowest
    outcome = [WINS] if wins and rmse < WORTHLESS else [FAILS] if rmse >= WORTHLESS else []
    return ", ".join([*outcome, *([BIASED] if share > 0.5 else [])])


def _text(row: object) -> str:
    status, verdict = getattr(row, "status"), getattr(row, "verdict")  # noqa: B009, rows of a table have no type
    if status != "ok":
        return str(status)
    middle, low, high = (number(float(getattr(row, name))) for name in ("rmse_rel", "low", "high"))
    times = float(getattr(row, "evaluations"))  # noqa: B009
    return (
        f"{middle} [{low}, {high}]" + (f" {verdict}" if verdict else "") + (f" ({times:.0f}x)" if times > MANY else "")
    )
