"""When may a first-order gradient be trusted? ``python -m bench.plugins.studies.bias_variance.trust results/standard`` counts.

The rules use the mean of the estimates, their spread between repeats and the remark on the row, but not the reference.
Each rule is scored on all stored cells of ``fobg`` (or of the estimators named after the folder): how many cells it
trusts, how many trusted cells are wrong (relative RMSE of :data:`WRONG` or more), and how many accurate cells it does
not trust.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.parameters import parsed
from bench.report.tables import plain_markdown
from bench.report.text import number
from bench.run.rows import read_parquet

from .. import PARTS, SPREAD
from .columns import COLUMNS

WRONG = 0.5
"""Relative RMSE at and above which an estimate counts as wrong: half of the gradient."""


def cells(folder: Path, estimators: Sequence[str]) -> pd.DataFrame:
    """Return the ok rows of some estimators, from all experiments below a folder that compare estimates with a reference."""
    tables = [pd.read_parquet(path) for path in sorted(folder.rglob("rows.parquet"))]
    needed = {"rmse_rel", "bias", "variance", "grad_norm"}
    rows = pd.concat([COLUMNS.derive(table) for table in tables if needed <= set(table)], ignore_index=True)
    return rows[rows["estimator"].isin(estimators) & (rows["status"] == "ok") & np.isfinite(rows["rmse_rel"])]


def spread(rows: pd.DataFrame) -> pd.Series:
    """Return the standard deviation of one estimate over the norm of the mean estimate; infinite where the norm is 0."""
    ratio = np.sqrt(rows["variance"]) / rows["grad_norm"].where(rows["grad_norm"] > 0)
    return ratio.fillna(np.inf)


def stable(rows: pd.DataFrame) -> pd.Series:
    """Return whether each row has no remark. A remark on heavy tails points to an unstable step."""
    return rows["reason"] == ""


def trusted(folder: Path, rows: pd.DataFrame) -> pd.Series:
    """Return whether each row of ``fobg`` can be trusted: ``yes``, ``no`` or ``not checked``; empty for others and without a result.

    Yes: an estimate spreads by less than half of its mean, and `gradcheck` has found nothing against the same program at the
    same theta, by the rows stored below a results ``folder``.
    """
    untrusted: dict[str, float] = {}
    for path in sorted(folder.glob("*/rows.parquet")):
        with suppress(Exception):  # no results of a gradient check, or a damaged file
            table = read_parquet(path, ["parameters", "untrusted"])
            for program, count in zip(table["parameters"].map(_program), table["untrusted"], strict=True):
                untrusted[program] = max(count, untrusted.get(program, 0.0))
    found = rows["parameters"].map(lambda text: untrusted.get(_program(text), math.nan))
    answers = np.select([(spread(rows) >= SPREAD) | (found > 0), found == 0], ["no", "yes"], "not checked")
    return pd.Series(answers, rows.index).where((rows["estimator"] == "fobg") & (rows["status"] == "ok"), "")


def _program(text: str) -> str:
    """Return what the parameters of a row say of its program and theta."""
    return json.dumps([parsed(text).get(part) for part in (*PARTS, "theta")])


def headline(answers: pd.Series) -> str:
    """Return in how many rows of ``fobg`` the estimates can be trusted; empty without any."""
    counts = {answer: int((answers == answer).sum()) for answer in ("yes", "no", "not checked")}
    how = " (to check: python -m bench gradcheck SCENE)" * bool(counts["not checked"])
    listed = ", ".join(f"{count} {answer}" for answer, count in counts.items() if count)
    return f"trusted: fobg {listed}{how}" if listed else ""


RULES: Mapping[str, Callable[[pd.DataFrame], Any]] = {
    "always": lambda rows: np.ones(len(rows), dtype=bool),
    "no remark on its interval": stable,
    f"spread of one estimate below {SPREAD:g} of its mean": lambda rows: spread(rows) < SPREAD,
    "both": lambda rows: stable(rows) & (spread(rows) < SPREAD),
}


def score_rules(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a line per rule: cells trusted, wrong cells trusted, worst trusted error, and right cells not trusted."""
    wrong = rows["rmse_rel"] >= WRONG
    lines = []
    for name, rule in RULES.items():
        trusted = np.asarray(rule(rows), dtype=bool)
        worst = rows.loc[trusted, "rmse_rel"].max()
        lines.append((name, trusted.sum(), (trusted & wrong).sum(), number(float(worst)), (~trusted & ~wrong).sum()))
    return pd.DataFrame(
        lines, columns=["rule", "trusted", "of those wrong", "worst relative RMSE", "right ones not trusted"]
    )


def main(words: Sequence[str]) -> None:
    """Print each rule's score; ``words`` are a results folder (default ``results/standard``) and estimators (``fobg``)."""
    folder, estimators = Path(words[0] if words else "results/standard"), words[1:] or ["fobg"]
    rows = cells(folder, estimators)
    print(
        f"{', '.join(estimators)}: {len(rows)} cells, {(rows['rmse_rel'] >= WRONG).sum()} wrong by {WRONG:g} of the gradient or more\n"
    )
    print(plain_markdown(score_rules(rows).astype(str)))


if __name__ == "__main__":
    main(sys.argv[1:])
