"""Rows arranged for reading, and numbers as text: what tables and charts share.

Rows along one swept axis (:func:`along`), one problem at a time (:func:`families`), and in it one line per estimator
with the backends that agree merged (:func:`lines`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.store import IDENTITY
from bench.timing import NOISY

if TYPE_CHECKING:
    from bench.grid import Experiment

LABELS = ("scene", "contact", "integrator", "backend", "estimator_params")
"""Columns of identity strings, in which plugin parameters without a column of their own are found."""
CATEGORIES = ("scene", "contact", "integrator", "noise")
NUMBERS = ("horizon", "dt", "stiffness", "sigma", "smoothing", "samples", "repeats")
"""Numeric identity columns; with the categories they say which problem a row is."""
UNITS = {"horizon": "steps", "dt": "s", "stiffness": "N/m", "kappa": "N m"}
UNSTEADY = "!"
"""Mark of a time whose calls spread too much."""
EXACT, CLOSE = 1e-6, 1e-2
"""Relative difference below which backends count as giving the same numbers, and nearly the same."""


def ran(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of cells that were not refused."""
    return rows[~rows["status"].isin(("unsupported", "unavailable"))]


def along(rows: pd.DataFrame, axis: str | None, experiment: Experiment) -> pd.DataFrame:
    """Rows that an axis applies to, seeds merged, its values in a new column ``x`` and nowhere else.

    The axis is a numeric column, a parameter in an identity string, or the parameter behind ``smoothing``. Without an
    axis ``x`` is 0.
    """
    table = merge_seeds(rows)
    if axis is None:
        return table.assign(x=0.0)
    name = short_axis(axis)
    if name in NUMBERS:
        table = table.assign(x=table[name], **{name: math.nan})
        return table[np.isfinite(table["x"])]
    pattern = re.compile(rf"(?:(?<=[\[,])|^){re.escape(name)}=([^,\]]*),?")
    for column in LABELS:
        if any(map(pattern.search, table[column])):
            return _along_label(table, column, pattern, _swept_values(experiment, axis))
    table = table[table["contact"].isin(_smoothed_by(axis, table, experiment))]
    return table.assign(x=table["smoothing"], smoothing=math.nan)


def _along_label(table: pd.DataFrame, column: str, pattern: re.Pattern[str], values: Sequence[float]) -> pd.DataFrame:
    """Rows along a parameter in identity strings; a default is in none, and is the one swept value that none has."""
    found = table[column].str.extract(pattern, expand=False)
    x = pd.to_numeric(found, errors="coerce").astype(float)
    unseen = [v for v in values if not np.isclose(x.dropna(), v, rtol=1e-9, atol=0.0).any()]
    if len(unseen) == 1:
        base = table["estimator"] if column == "estimator_params" else table[column].str.partition("[")[0]
        x = x.where(found.notna() | ~base.isin(base[found.notna()]), unseen[0])
    stripped = table[column].str.replace(pattern, "", regex=True)
    stripped = stripped.str.replace(r",(?=\]|$)", "", regex=True).str.replace("[]", "", regex=False)
    return table.assign(x=x, **{column: stripped})[np.isfinite(x)]


def short_axis(axis: str) -> str:
    """The parameter of a dotted axis name."""
    return axis.rpartition(".")[2]


def _swept_values(experiment: Experiment, axis: str) -> list[float]:
    from bench.grid import points

    found = dict.fromkeys(point[axis] for point in points(experiment.sweep) if axis in point)
    return [float(v) for v in found if isinstance(v, int | float) and not isinstance(v, bool)]


def _smoothed_by(axis: str, table: pd.DataFrame, experiment: Experiment) -> list[str]:
    """The contact laws whose ``smoothing`` takes the values of an axis, and more of them than of any other axis."""
    from bench.grid import swept

    axes = {a: _swept_values(experiment, a) for a in swept(experiment.sweep) if short_axis(a) not in NUMBERS}
    laws = []
    for contact, values in table.groupby("contact")["smoothing"]:
        shared = {a: np.isin(values.unique(), given).sum() for a, given in axes.items()}
        if 2 <= shared.get(axis, 0) == max(shared.values()):
            laws.append(str(contact))
    return laws


def numeric_axes(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> dict[str, int]:
    """The swept axes with at least two values in the rows, and how many; one of each parameter name."""
    found: dict[str, int] = {}
    for axis in axes:
        if short_axis(axis) not in ("seed", *map(short_axis, found)):
            count = along(rows, axis, experiment)["x"].nunique()
            if count > 1:
                found[axis] = count
    return found


def merge_seeds(rows: pd.DataFrame) -> pd.DataFrame:
    """One row per cell whatever the seed, medians over the seeds that ended well; ``lost`` counts those that did not."""
    good = rows["status"] == "ok"
    rows = rows.assign(lost=(~good & rows.index.isin(ran(rows).index)).astype(float))
    if rows["seed"].nunique() < 2:
        return rows
    cell = rows.groupby([c for c in IDENTITY if c != "seed"], dropna=False, sort=False).ngroup()
    merged = rows.assign(cell=cell, bad=~good).sort_values("bad", kind="stable").drop_duplicates("cell")
    merged = merged.set_index("cell").sort_index().drop(columns="bad")
    medians = rows[good].groupby(cell[good])[list(rows.select_dtypes("number").columns)].median()
    merged.loc[medians.index, medians.columns] = medians
    return merged.assign(lost=rows["lost"].groupby(cell).sum()).reset_index(drop=True)


@dataclass(frozen=True, eq=False)
class Family:
    """The rows of one problem along an axis, and the names and values that tell it from its neighbours."""

    identity: Mapping[str, Any]
    rows: pd.DataFrame

    def title(self) -> str:
        """``pushing, penalty, sigma=0.1``."""
        return ", ".join(str(v) if k in CATEGORIES else f"{k}={axis_value(v)}" for k, v in self.identity.items())


def families(
    table: pd.DataFrame, always: Sequence[str] = (), smoothing: Mapping[str, str] | None = None
) -> list[Family]:
    """The problems of a table made by :func:`along`, in order of appearance; ``always`` are columns to name anyway.

    A numeric column splits problems when it varies at fixed ``x``; one that moves with ``x`` (a zipped axis) does not.
    ``smoothing`` names the parameter behind that column for each contact law.
    """
    if table.empty:
        return []
    fixed = [*CATEGORIES, "backend", "dtype", "estimator", "estimator_params", "x"]
    varied = table.groupby(fixed, dropna=False)[list(NUMBERS)].nunique(dropna=False).max()
    keys = [*CATEGORIES, *(c for c in NUMBERS if varied[c] > 1)]
    groups = [(dict(zip(keys, key, strict=True)), part) for key, part in table.groupby(keys, dropna=False, sort=False)]

    def distinct(names: Sequence[str]) -> int:
        return len({tuple(str(identity[name]) for name in names) for identity, _ in groups})

    telling: list[str] = []
    for key in keys:
        if key in always or distinct([*telling, key]) > distinct(telling):
            telling.append(key)
    found = []
    for identity, part in groups:
        own = {"smoothing": (smoothing or {}).get(identity["contact"].partition("[")[0]) or "smoothing"}
        told = {own.get(k, k): identity[k] for k in telling or ("scene", "contact") if _tells(k, identity[k])}
        found.append(Family(told, part.reset_index(drop=True)))
    return found


def _tells(column: str, value: Any) -> bool:
    if column in CATEGORIES:
        return bool(value != "none")
    return math.isfinite(value) and not (column == "horizon" and value == 0)


@dataclass(frozen=True, eq=False)
class Line:
    """One estimator along ``x``, on one backend or on several that agree."""

    estimator: str
    params: str
    backends: Mapping[str, bool]
    """Backends whose numbers these are; False where they agree only nearly."""
    rows: pd.DataFrame
    """The first backend's rows, indexed by ``x`` in increasing order."""
    seconds: Mapping[str, float]
    """Median time per estimate on each backend."""
    noisy: frozenset[str]
    """Backends whose timings spread too much for most of the rows."""
    failed: int

    @cached_property
    def at(self) -> dict[float, dict[str, Any]]:
        """The rows by ``x``."""
        return {float(x): row for x, row in zip(self.rows.index, self.rows.to_dict("records"), strict=True)}

    @property
    def label(self) -> str:
        """The estimator's identity string."""
        return f"{self.estimator}[{self.params}]" if self.params else self.estimator


def lines(rows: pd.DataFrame, close: float | None = CLOSE) -> list[Line]:
    """The lines of one family, in order of appearance; cells that were never run are left out.

    Backends within a relative difference of ``close`` are one line; each is its own without it.
    """
    rows = ran(rows)
    several = rows["dtype"].nunique() > 1
    found = []
    for (estimator, params), part in rows.groupby(["estimator", "estimator_params"], sort=False):
        runs: dict[str, pd.DataFrame] = {}
        for (backend, dtype), run in part.groupby(["backend", "dtype"], sort=False):
            name = f"{backend} {dtype}" if several else str(backend)
            runs[name] = run.drop_duplicates("x", keep="last").set_index("x").sort_index()
        while runs:
            first, mine = next(iter(runs.items()))
            alike = [n for n, run in runs.items() if n == first or (close is not None and _agree(mine, run, close))]
            exact = {name: name == first or _agree(mine, runs[name], EXACT) for name in alike}
            backends = dict(sorted(exact.items(), key=lambda item: not item[1]))
            seconds = {name: float(runs[name]["time_s"].median()) for name in backends}
            noisy = frozenset(name for name in backends if unsteady(runs[name]).mean() > 0.5)
            failed = sum(int(runs[name]["lost"].sum()) for name in backends)
            found.append(Line(str(estimator), str(params), backends, mine, seconds, noisy, failed))
            runs = {name: run for name, run in runs.items() if name not in backends}
    return found


def _agree(a: pd.DataFrame, b: pd.DataFrame, tolerance: float) -> bool:
    """Whether two backends ended alike at every ``x`` and gave numbers within a relative tolerance."""
    if not a.index.equals(b.index) or not (a["status"] == b["status"]).all():
        return False
    for name, scale in (("rmse", "rmse"), ("variance", "variance"), ("bias_high", "bias_high"), ("bias", "bias_high")):
        same = (a[name] == b[name]) | (a[name].isna() & b[name].isna())
        margin = tolerance * a[scale].abs().combine(b[scale].abs(), max)
        if not (same | ((a[name] - b[name]).abs() <= margin)).all():
            return False
    return True


def pareto(time: pd.Series, error: pd.Series) -> np.ndarray:
    """Mask of the points for which no other is smaller in both."""
    points = pd.DataFrame({"time": time.to_numpy(), "error": error.to_numpy()})
    best = points.groupby("time")["error"].min().cummin().shift(fill_value=math.inf)
    return (points["error"] <= points["time"].map(best)).to_numpy()


def number(value: float, digits: int = 2) -> str:
    """A number in few characters: ``0.021``, ``350``, ``1.2e5``; ``-`` for a missing one."""
    if not math.isfinite(value):
        return "-" if math.isnan(value) else str(float(value))
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)
    if -4 < power < max(digits, 4):
        return f"{float(f'{mantissa}e{power}'):.{max(digits - 1 - power, 0)}f}"
    return f"{mantissa}e{power}"


def axis_value(value: float) -> str:
    """A value on an axis: ``0.01``, ``3000``, ``1e4``."""
    if not math.isfinite(value):
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:g}"
    mantissa, exponent = f"{value:e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"


def unsteady(rows: Any) -> Any:
    """Whether the interquartile range of a timing is over 20% of its median: of one row, or of each of several."""
    return rows["time_iqr_s"] > NOISY * rows["time_s"]


def duration(seconds: float) -> str:
    """``0.21 ms``, ``12 ms``, ``1.5 s``."""
    if not math.isfinite(seconds):
        return "-"
    for unit, factor in (("us", 1e6), ("ms", 1e3)):
        if seconds * factor < 999.5:
            return f"{number(seconds * factor)} {unit}"
    return f"{number(seconds)} s"


def axis_text(axis: str) -> str:
    """The axis with its unit: ``stiffness [N/m]``."""
    name = short_axis(axis)
    return f"{name} [{UNITS[name]}]" if name in UNITS else name


def resolved(row: Any) -> Any:
    """Whether the bias of a row, or of each of some rows, can be told from 0."""
    return row["bias_low"] > 0


def relative(row: Any, column: str) -> float:
    """A column of a row in units of |grad J|; NaN where that is 0."""
    norm = row["reference_norm"]
    return float(row[column] / norm) if norm > 0 else math.nan


def bias_text(row: Any, norm: float = 1.0, interval: bool = True) -> str:
    """A bias over a norm: ``0.500 [0.400, 0.600]``, or ``0 (< 0.124)`` where it cannot be told from 0."""
    value, low, high = (row[c] / norm if norm > 0 else math.nan for c in ("bias", "bias_low", "bias_high"))
    if not low > 0 and math.isfinite(high):
        return f"0 (< {number(high, 3)})" if high > 0 else "0"
    text = number(value, 3)
    return f"{text} [{number(low, 3)}, {number(high, 3)}]" if interval and math.isfinite(low + high) else text


def smoothing_parameters() -> dict[str, str]:
    """The parameter behind the column ``smoothing`` for each contact law that has one."""
    from bench import registry
    from bench.contracts import ContactLaw

    laws = [entry.plugin for entry in registry.entries()["contacts"].values()]
    return {law.name: law.smoothing for law in laws if law is not None and issubclass(law, ContactLaw)}
