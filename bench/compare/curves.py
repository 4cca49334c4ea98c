"""Aggregates learning curves of any origin over tasks and seeds: interquartile mean, optimality gap, performance profile.

Source: Agarwal et al. 2021, *Deep RL at the edge of the statistical precipice* (stratified bootstrap, interquartile mean,
optimality gap, score distributions). Intervals are at 95%.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from bench.errors import UserError
from bench.experiment.columns import Column, text
from bench.experiment.views import Chart, Table, Views
from bench.experiment.words import parse_words
from bench.measure import performance
from bench.report.text import counted, number
from bench.run.files import make_directory, write_all

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMES = ("task", "method", "seed", "return")
AXES = ("step", "seconds")
SETTINGS = {"axis": "", "better": "higher", "out": "runs/aggregate"}
POINTS = 41
"""Points of an aggregated curve and of a performance profile."""
DRAWS = 400
"""Resamples per interval."""
FEW = 5
"""Fewest runs of a method on a task for which a bootstrap interval is stated without a remark."""
FEWEST = 3
"""Fewest runs of a method on a task for which a method is called better than another."""
SHARE = Column("share", "share of the task's budget", label="share of the budget")
IQM = Column(
    "iqm", "interquartile mean of the scores, with fractional weights at its edges", label="IQM of the scores",
    low="iqm_low", high="iqm_high", digits=3, log=False,
)  # fmt: skip
SCORE = Column("score", "score tau", log=False)
ABOVE = Column(
    "above",
    "share of runs with a score above tau",
    label="share of runs above",
    low="above_low",
    high="above_high",
    log=False,
)
COLUMNS = (
    text("method"),
    Column("runs", "runs that score"),
    Column("failed", "runs whose return at the budget is not finite; their score is 0"),
    replace(IQM, label="IQM"),
    Column("iqm_rliable", "interquartile mean without fractional weights, as rliable computes it", label="IQM, rliable", digits=3),
    Column("median", "median over tasks of the mean score", digits=3),
    Column("mean", "mean score", digits=3),
    Column("gap", "mean shortfall of the scores below 1", label="optimality gap", low="gap_low", high="gap_high", digits=3),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Aggregate:
    """Scores of methods over tasks and seeds. ``print`` shows the findings and the table."""

    table: pd.DataFrame
    """A line per method, the highest interquartile mean first, with 95% intervals in ``*_low`` and ``*_high``."""
    curves: pd.DataFrame
    """``method``, ``share`` of the budget, ``iqm`` with its interval."""
    profile: pd.DataFrame
    """``method``, ``score`` and the share ``above`` of the runs with a higher score, with its interval."""
    tasks: Sequence[str]
    axis: str
    finding: str
    remarks: Sequence[str] = field(default_factory=tuple)

    def __repr__(self) -> str:
        return "\n".join(
            [self.finding, *self.remarks, self.table.to_string(index=False, float_format=lambda x: f"{x:.3g}")]
        )

    def _repr_html_(self) -> str:
        return str(self.table.to_html(index=False, float_format=lambda x: f"{x:.3g}"))

    def to_frame(self) -> pd.DataFrame:
        """Return the table, a line per method."""
        return self.table.copy()

    def plot(self) -> Figure:
        """Return the chart of the interquartile mean against the share of the budget."""
        from bench.report.displays import displayable
        from bench.report.draw import draw
        from bench.report.figures import styled

        with styled():
            return displayable(draw(views(self).charts[0]))


def aggregate_curves(curves: pd.DataFrame | str | Path, axis: str, better: str) -> Aggregate:
    """Aggregate learning curves; see :func:`bench.aggregate`."""
    if better not in ("higher", "lower"):
        raise UserError(f"better is '{better}': allowed are higher and lower")
    table, axis = _checked(curves if isinstance(curves, pd.DataFrame) else _read(Path(curves)), axis)
    table = table.assign(**{"return": table["return"] * (1.0 if better == "higher" else -1.0)})
    methods, tasks = list(table["method"].unique()), list(table["task"].unique())
    counts = table.groupby("task")["method"].nunique()
    shared = [task for task in tasks if counts[task] == len(methods)]
    if not shared:
        raise UserError(f"no task has runs of all methods ({', '.join(methods)})")
    scores = {task: _scores(table[table["task"] == task], axis, better) for task in shared}
    lines, curve_lines, profile_lines, final = [], [], [], {}
    taus = np.linspace(0.0, 1.0, POINTS)
    for method in methods:
        parts = [scores[task][method] for task in shared]  # a task each: (runs, POINTS)
        failed = sum(int(np.isnan(part[:, -1]).sum()) for part in parts)
        parts = [np.nan_to_num(part, nan=0.0) for part in parts]
        ends = final[method] = [part[:, -1] for part in parts]
        iqm_low, iqm_high = performance.bootstrap(ends, _iqm, draws=DRAWS)
        gap_low, gap_high = performance.bootstrap(ends, _gap, draws=DRAWS)
        lines.append({
            "method": method, "runs": sum(map(len, ends)), "failed": failed, "iqm": _iqm(ends), "iqm_low": iqm_low,
            "iqm_high": iqm_high, "iqm_rliable": _trimmed(ends), "median": float(np.median([end.mean() for end in ends])),
            "mean": float(np.mean([end.mean() for end in ends])), "gap": _gap(ends), "gap_low": gap_low, "gap_high": gap_high,
        })  # fmt: skip
        curve_lines += _lines(parts, _iqm_along, {"method": method}, ("share", np.linspace(0, 1, POINTS)), "iqm")
        profile_lines += _lines(ends, lambda some: _above(some, taus), {"method": method}, ("score", taus), "above")
    best_first = pd.DataFrame(lines).sort_values("iqm", ascending=False, kind="stable", ignore_index=True)
    remarks = []
    if len(shared) < len(tasks):
        remarks.append(
            f"Left out, without runs of every method: {', '.join(task for task in tasks if task not in shared)}."
        )
    fewest = min(len(end) for ends in final.values() for end in ends)
    if fewest < FEW:
        remarks.append(
            f"A task has only {counted(fewest, 'run')} of a method: intervals from fewer than {FEW} are too narrow."
        )
    return Aggregate(
        best_first, pd.DataFrame(curve_lines), pd.DataFrame(profile_lines), shared, axis, _finding(best_first, final, fewest), remarks
    )  # fmt: skip


def _read(file: Path) -> pd.DataFrame:
    try:
        return pd.read_csv(file)
    except (OSError, ValueError) as error:  # a parser's error is a ValueError
        raise UserError(f"{file} cannot be read as CSV: {error}") from None


def _checked(table: pd.DataFrame, axis: str) -> tuple[pd.DataFrame, str]:
    """Return the needed columns with their types, and the axis. Raises :class:`UserError` for what is missing or not a number."""
    present = list(map(str, table.columns))
    axis = axis or next((name for name in AXES if name in present), AXES[0])
    if axis not in AXES:
        raise UserError(f"axis is '{axis}': allowed are {' and '.join(AXES)}")
    for name in (*NAMES, axis):
        if name not in present:
            near = difflib.get_close_matches(name, present, 1)
            hint = f"; rename '{near[0]}'" if near else ""
            raise UserError(
                f"the learning curves have no column '{name}'{hint}. Columns: {', '.join(present) or 'none'}"
            )
    bounds = [name for name in ("low", "high") if name in present]
    if len(bounds) == 1:
        raise UserError(f"the learning curves have only the column '{bounds[0]}': give both low and high, or neither")
    if table.empty:
        raise UserError("the learning curves have no lines")
    table = table[[*NAMES, axis, *bounds]].copy()
    for name in ("return", axis, *bounds):
        values = pd.to_numeric(table[name], errors="coerce")
        wrong = values.isna() & table[name].notna()
        if wrong.any():
            raise UserError(f"column '{name}' has '{table.loc[wrong, name].iloc[0]}', which is not a number")
        table[name] = values.astype(float)
    if not np.isfinite(table[axis]).all() or (table[axis] < 0).any():
        raise UserError(f"column '{axis}' has a value that is missing, infinite or negative")
    for name in ("task", "method", "seed"):
        if table[name].isna().any():
            raise UserError(f"column '{name}' has a missing value")
        table[name] = table[name].astype(str)
    keys = ["task", "method", "seed", axis]
    means = table.groupby(keys, sort=False, as_index=False)["return"].mean(skipna=False)
    return means.merge(table[[*keys, *bounds]].drop_duplicates(), on=keys) if bounds else means, axis


def _scores(table: pd.DataFrame, axis: str, better: str) -> dict[str, np.ndarray]:
    """Return the scores of a task by method, ``(runs, POINTS)`` at equal shares of the budget; NaN where not finite."""
    runs = [
        (str(key[0]), run.sort_values(axis, kind="stable"))
        for key, run in table.groupby(["method", "seed"], sort=False)
    ]
    budget = min(run[axis].iloc[-1] for _, run in runs)
    within = table.loc[(table[axis] <= budget) & np.isfinite(table["return"]), "return"]
    low, high = (within.min(), within.max()) if len(within) else (0.0, 0.0)
    if "low" in table:
        if table[["low", "high"]].nunique().max() > 1 or table[["low", "high"]].isna().any(axis=None):
            raise UserError(
                f"task {table['task'].iloc[0]} has several values of low or high: give one of each per task"
            )
        sign = 1.0 if better == "higher" else -1.0
        low, high = sign * table["low"].iloc[0], sign * table["high"].iloc[0]
        if not low < high:
            raise UserError(
                f"task {table['task'].iloc[0]}: 'high' must be better than 'low', given {sign * low:g} to {sign * high:g}"
            )
    shares: dict[str, list[np.ndarray]] = {}
    for method, run in runs:
        places = np.searchsorted(run[axis].to_numpy(), np.linspace(0.0, budget, POINTS) * (1 + 1e-12), side="right") - 1
        values = run["return"].to_numpy()[
            np.maximum(places, 0)
        ]  # before its first evaluation a run has the return of that
        values = np.where(np.isfinite(values), values, np.nan)
        shares.setdefault(method, []).append(
            (values - low) / (high - low) if high > low else np.where(np.isnan(values), np.nan, 1.0)
        )
    return {method: np.stack(parts) for method, parts in shares.items()}


def _iqm(parts: Sequence[np.ndarray]) -> float:
    return performance.interquartile_mean(np.concatenate(parts))


def _trimmed(parts: Sequence[np.ndarray]) -> float:
    from scipy.stats import trim_mean

    return float(trim_mean(np.concatenate(parts), 0.25))


def _gap(parts: Sequence[np.ndarray]) -> float:
    return float(np.mean(np.maximum(1.0 - np.concatenate(parts), 0.0)))


def _iqm_along(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.array([performance.interquartile_mean(column) for column in np.concatenate(parts).T])


def _above(parts: Sequence[np.ndarray], taus: np.ndarray) -> np.ndarray:
    """Return the share of scores above each tau: the score distribution of Agarwal et al. 2021, section 4.2."""
    return np.asarray((np.concatenate(parts)[:, None] > taus).mean(axis=0))


def _lines(
    parts: Sequence[np.ndarray], along: Callable[[Sequence[np.ndarray]], np.ndarray], shared: dict[str, str],
    x: tuple[str, np.ndarray], name: str,
) -> list[dict[str, object]]:  # fmt: skip
    """Return a line per point of ``x``: the statistic ``along`` it with its stratified bootstrap interval."""
    intervals = performance.bootstrap_along(parts, along, draws=DRAWS)
    return [
        {**shared, x[0]: float(place), name: float(value), f"{name}_low": low, f"{name}_high": high}
        for place, value, (low, high) in zip(x[1], along(parts), intervals, strict=True)
    ]


def _finding(table: pd.DataFrame, final: dict[str, list[np.ndarray]], fewest: int) -> str:
    """Return which method has the highest interquartile mean, and which are not distinguishable from it."""
    best = table.iloc[0]
    if len(table) > 1 and fewest < FEWEST:
        return (
            f"Open which method is better: a task has only {counted(fewest, 'run')} of a method, {FEWEST} are needed."
        )
    tied = [
        str(other)
        for other in table["method"].iloc[1:]
        if _difference(final[str(best["method"])], final[str(other)])[0] <= 0
    ]
    sentence = (
        f"{best['method']} has the highest interquartile mean, {number(best['iqm'])} "
        f"[{number(best['iqm_low'])}, {number(best['iqm_high'])}]"
    )
    return f"{sentence}, not distinguishable from {' and '.join(tied)}." if tied else f"{sentence}."


def _difference(ours: list[np.ndarray], theirs: list[np.ndarray]) -> performance.Interval:
    """Return the bootstrap interval of the difference of two interquartile means."""
    return performance.bootstrap(
        [*ours, *theirs], lambda some: _iqm(some[: len(ours)]) - _iqm(some[len(ours) :]), draws=DRAWS
    )


# --------------------------------------------------------------------------------------------------------- files


def views(result: Aggregate) -> Views:
    """Return the finding, the table, and the charts of scores against budget and of the score distributions."""
    notes = [
        f"Scores of {counted(len(result.tasks), 'task')}: 0 is a task's low, 1 its high. The budget of a task is its shortest run.",
        *[f"{column.heading}: {column.doc}." for column in COLUMNS if column.doc],
    ]
    table = Table("aggregate", result.table, COLUMNS, result.finding.rstrip("."), notes, terminal=True)
    share = replace(SHARE, label=f"share of the task's budget of {'seconds' if result.axis == 'seconds' else 'steps'}")
    charts = [
        Chart("curves", result.curves, [share], [IQM], title=result.finding, series="method", labels="ends", band=True,
              subtitle=f"interquartile mean over {counted(len(result.tasks), 'task')} and all seeds, 95% intervals"),
        Chart("profile", result.profile, [replace(SCORE, label="score")], [ABOVE], title=result.finding, series="method", band=True,
              subtitle="score distributions: the higher curve is better, where the bands are apart"),
    ]  # fmt: skip
    return Views([table], charts, remarks=result.remarks, headline=result.finding)


def main(words: Sequence[str]) -> int:
    """Aggregate the CSV file named in ``words``, print the table and write the files. Returns 0. Raises :class:`UserError`."""
    from bench.report import terminal
    from bench.report.cells import readable
    from bench.report.draw import draw
    from bench.report.figures import save, styled
    from bench.report.writer import table_files

    names, settings, _ = parse_words(words, "aggregate", SETTINGS)
    if len(names) != 1:
        raise UserError(
            "name one file: python -m bench aggregate FILE.csv [axis=step|seconds] [better=higher|lower] [out=DIR]"
        )
    result = aggregate_curves(names[0], settings["axis"], settings["better"])
    shown, console = views(result), terminal.open_console()
    for sentence in (shown.headline, *shown.remarks):
        console.print(sentence)
    right = {column.heading for column in COLUMNS if column.kind == "number"}
    terminal.print_table(console, readable(shown.tables[0]), right=right)
    out = Path(settings["out"]).expanduser()
    make_directory(out)
    paths = list(write_all(out, table_files(shown.tables, "Learning curves")))
    with styled():
        for chart in shown.charts:
            paths += save(draw(chart), out / chart.name, data=chart.plotted())
    for path in paths:
        print(f"  {path}")
    return 0
