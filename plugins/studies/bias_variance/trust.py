"""When may a first-order gradient be trusted? ``python -m bench.plugins.studies.bias_variance.trust results/standard`` counts.

The rule uses the mean of the estimates and their spread between repeats, but not the reference. It is counted on all stored
cells of ``fobg``, or of the estimators named after the folder: how many cells it trusts, how many of them are wrong (relative
RMSE of :data:`WRONG` or more), and how many of the others are right.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd

from bench.experiment.parameters import parsed
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


def counts(rows: pd.DataFrame) -> dict[str, int]:
    """Return the numbers of cells, of trusted ones and the wrong ones among them, of others and the right ones among them."""
    keep, wrong = spread(rows) < SPREAD, rows["rmse_rel"] >= WRONG
    kinds = dict(cells=keep | ~keep, trusted=keep, wrong=keep & wrong, others=~keep, missed=~keep & ~wrong)
    return {name: int(kind.sum()) for name, kind in kinds.items()}


def main(words: Sequence[str]) -> None:
    """Print the counts; ``words`` are a results folder (default ``results/standard``) and estimators (``fobg``)."""
    folder, estimators = Path(words[0] if words else "results/standard"), words[1:] or ["fobg"]
    text = (
        "the spread trusts {trusted} of {cells} cells, {wrong} of them wrong; of the {others} others {missed} are right"
    )
    print(f"{', '.join(estimators)}: {text.format(**counts(cells(folder, estimators)))}")


if __name__ == "__main__":
    main(sys.argv[1:])
