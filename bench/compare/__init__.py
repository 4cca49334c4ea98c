"""Compares two sets of results cell by cell: did something get worse?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import pandas as pd

    from bench.compare.curves import Aggregate
    from bench.compare.report import Comparison

__all__ = ["aggregate", "compare"]


def aggregate(
    curves: pd.DataFrame | str | Path, axis: str = "", better: Literal["higher", "lower"] = "higher"
) -> Aggregate:
    """Aggregate learning curves of any origin over tasks and seeds; ``print`` shows which method is ahead.

    ``curves``, a table or a CSV file, has the columns ``task``, ``method``, ``seed``, ``return`` and at least one of ``step``
    and ``seconds``, with a line per evaluation. ``axis`` names the one that measures the budget, by default the first of
    them. The result has the interquartile mean, the median and the mean of the scores, the optimality gap and the score
    distribution of each method, with 95% intervals: ``result.to_frame()``, ``result.curves``, ``result.profile``,
    ``result.plot()``.

    Several lines of a run at one place of the axis, such as episodes of one evaluation, are averaged. The budget of a
    task is the shortest run's, and a run's result is its last return within it. Scores are ``(return - low) / (high -
    low)``, where ``low`` and ``high`` are columns of the table, or else the task's lowest and highest return within the
    budget. A result that is not finite scores 0. Tasks without runs of every method are left out. Raises
    :class:`bench.UserError` for other tables.

    Source: Agarwal et al. 2021, *Deep RL at the edge of the statistical precipice*, sections 4.1 to 4.3.
    """
    from bench.compare.curves import aggregate_curves

    return aggregate_curves(curves, axis, better)


def compare(
    before: str | Path, after: str | Path, timings: bool = False, again: Sequence[str | Path] = ()
) -> Comparison:
    """Compare two results, cell by cell; ``print`` shows what got worse or better.

    ``before`` and ``after`` are directories of experiments or of one experiment, or git revisions as ``REV`` or
    ``REV:PATH``. ``comparison.to_frame()`` has one row per cell, and ``comparison.worse`` is true if some cell got
    worse. With ``timings``, times are compared too, with the spread between the runs ``again`` of ``before``. Raises
    :class:`bench.UserError` for results that cannot be read or compared.
    """
    from bench.compare.command import compare_results, request

    return compare_results(request(str(before), str(after), timings=timings, again=tuple(map(str, again))))
