"""The columns of rows: their kinds, units and meanings, and what ``compare`` does with each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

Kind = Literal["number", "text", "list"]
Format = Literal["number", "seconds", "percent", "setting"]
"""How a number is shown: rounded, as a time, as a percentage, or as a setting, whose digits are all known."""


@dataclass(frozen=True)
class ComparisonRule:
    """How ``compare`` decides whether a column got worse. Smaller is better unless ``neutral``.

    - ``interval``: estimated, with columns ``<name>_low`` and ``<name>_high``; changed if the intervals do not overlap.
    - ``spread``: changed if the intervals do not overlap and the ratio is large enough to matter (a variance).
    - ``paired``: an error estimated with the same noise in both results; changed if the mean estimate in the column
      ``mean`` or the variance in the column ``variance`` moved by more than rounding; worse or better by the root mean
      squared error about the previous gradient in the column ``reference``.
    - ``exact``: computed without noise; changed by a ratio that matters and by more than rounding.
    - ``vector``: a list of numbers computed without noise; changed by more than rounding, neither better nor worse.
    - ``time``: seconds, compared on request only, and relative to the spread between runs.
    - ``verdict``: one of ``order``, which starts with the worst.
    """

    by: Literal["interval", "spread", "paired", "exact", "vector", "time", "verdict"]
    called: str
    """The column's name in sentences."""
    neutral: bool = False
    """Whether a change is neither better nor worse."""
    order: tuple[str, ...] = ()
    mean: str = ""
    variance: str = ""
    reference: str = ""


@dataclass(frozen=True)
class Column:
    """A quantity: its name in the rows, its meaning, and how every table, chart, page and terminal shows it."""

    name: str
    doc: str = ""
    unit: str = ""
    kind: Kind = "number"
    comparison: ComparisonRule | None = None
    """How ``compare`` decides whether the column got worse; None to ignore the column."""
    table: bool = True
    """Whether the CSV has this column; ``rows.parquet`` always does."""
    measured: bool = False
    """Whether the value depends on the machine and its load; it is missing if cells are not timed, unless ``untimed``."""
    label: str = field(default="", kw_only=True)
    """The name in headings and on axes; by default the column's name with spaces."""
    untimed: bool = field(default=False, kw_only=True)
    """Whether a measured value is recorded also if cells are not timed: beside other cells, for a ratio of costs only."""
    format: Format = field(default="number", kw_only=True)
    digits: int = field(default=2, kw_only=True)
    """Significant digits in tables for readers."""
    low: str = field(default="", kw_only=True)
    high: str = field(default="", kw_only=True)
    """The columns with the ends of the interval, empty if there is none."""
    ends: str = field(default="95% interval", kw_only=True)
    """What the interval contains, in the legends of charts."""
    boundary: float | None = field(default=None, kw_only=True)
    """The value that intervals are compared with: an end that differs from it never prints as it."""
    limit: str = field(default="", kw_only=True)
    """The column that is true where the value is an upper limit."""
    least: float = field(default=0.0, kw_only=True)
    """Smaller values are drawn here on a logarithmic axis, as upper limits."""
    log: bool | None = field(default=None, kw_only=True)
    """Whether its axis is logarithmic; None: if all values are positive and span a factor of 8."""
    emphasis: str = field(default="", kw_only=True)
    """The column that is true where tables print the value in bold."""
    note: str = field(default="", kw_only=True)
    """The column of words that tables append to the value, or show in place of a missing one."""
    derived: Callable[[pd.DataFrame], Any] | None = field(default=None, kw_only=True)
    """How the values follow from other columns whenever rows are read, whatever was stored; None if they do not."""
    above_one: str = field(default="", kw_only=True)
    """The meaning of values above 1; charts shade that area."""
    default: Any = field(default=None, kw_only=True)
    """The value in rows that were stored before the column existed; None: it is missing there."""

    @property
    def heading(self) -> str:
        """The label with its unit: ``time step [s]``."""
        label = self.label or self.name.replace("_", " ")
        return f"{label} [{self.unit}]" if self.unit and self.format != "seconds" else label


def interval(name: str, doc: str = "", unit: str = "", **more: Any) -> Column:
    """Return a column of numbers whose 95% intervals end in the columns ``<name>_low`` and ``<name>_high``."""
    return Column(name, doc, unit, low=f"{name}_low", high=f"{name}_high", **more)


def bounded(
    name: str,
    doc: str,
    unit: str = "",
    of: str = "its 95% interval",
    stem: str = "",
    kind: Callable[..., Column] = Column,
    has_csv: bool = True,
    **more: Any,
) -> list[Column]:
    """Return a column and those of the ends of its intervals ``of`` some kind, ``<stem>_low`` and ``<stem>_high``."""
    names = [f"{stem or name}_{end}" for end in ("low", "high")]
    plain = {"measured": more.get("measured", False), "table": has_csv}
    more = {"ends": of.partition(" ")[2]} | more
    ends = zip(names, ("lower", "upper"), strict=True)
    return [
        kind(name, doc, unit, low=names[0], high=names[1], **more),
        *(kind(end, f"{which} end of {of}", unit, **plain) for end, which in ends),
    ]


def exact(name: str, doc: str, called: str, label: str = "", **more: Any) -> Column:
    """Return a column of numbers without noise; ``called`` is its name in sentences of ``compare``."""
    return Column(name, doc, comparison=ComparisonRule("exact", called), label=label, **more)


def setting(name: str, doc: str = "", unit: str = "", **more: Any) -> Column:
    """Return a column of chosen numbers and counts, which tables print in full."""
    return Column(name, doc, unit, format="setting", **more)


def seconds(name: str, doc: str, label: str = "", **more: Any) -> Column:
    """Return a column of measured times."""
    return Column(name, doc, "s", measured=True, label=label, format="seconds", **more)


def text(name: str, doc: str = "", **more: Any) -> Column:
    """Return a column of strings."""
    return Column(name, doc, kind="text", **more)


def numbers(name: str, doc: str = "", unit: str = "", **more: Any) -> Column:
    """Return a column whose values are lists of numbers or strings."""
    return Column(name, doc, unit, kind="list", **more)


def several(kind: Callable[..., Column], docs: Mapping[str, str], **more: Any) -> list[Column]:
    """Return columns of one kind, such as :func:`numbers`, from a table of their names and meanings."""
    return [kind(name, doc, **more) for name, doc in docs.items()]


FIRST = (
    text("experiment", "experiment of the row"),
    text("scene", "identity string of the scene: its name and the parameters that differ from their defaults"),
    text("contact", "identity string of the contact law, `none` where the scene has no contact"),
    text("integrator", "identity string of the integrator, `none` where the scene has no time steps"),
    text("backend", "identity string of the backend"),
    text("estimator", "name of the estimator"),
    text("estimator_params", "parameters of the estimator that differ from their defaults"),
    text("noise", "what the noise perturbs: `parameter` (theta) or `action`"),
    setting("horizon", "number of time steps T", "steps"),
    setting("dt", "length of a time step", "s"),
    setting("stiffness", "stiffness of the contact law, or, in the unit of its own, of the scene without one", "N/m"),
    setting("sigma", "standard deviation of the noise in J"),
    setting("smoothing", "smoothing parameter of the contact law: beta, kappa"),
    setting("descent", "share of a descent from theta0 that is done where the gradient is taken", default=0.0),
    setting("samples", "samples N in one estimate"),
    setting("repeats", "independent estimates R that measure bias and variance"),
    setting("seed", "seed of the noise"),
    text("dtype", "floating-point type of the simulation"),
)
IDENTITY = tuple(column.name for column in FIRST[1:])
"""The columns that show which cell a row is. The cell's whole identity is in ``parameters``."""
DIM = setting("dim", "length d of theta")
STATUS = (
    text("status", "ok, or how the cell failed"),
    text("reason", "reason of a failure, or a remark about the numbers"),
)
LAST = (
    text("versions", "versions of the libraries that produced the numbers"),
    text("key", "hash of all parameters and code that decide the numbers"),
)
DRAWS = (
    text("draws", "points of the noise of an estimate: iid, orthogonal or sobol", default="iid"),
    setting("mirrored", "1 if each draw w of the noise is followed by -w", default=0.0),
)
HIDDEN = (
    *(replace(column, table=False) for column in DRAWS),
    text("study", "study that measured the row", table=False),
    text(
        "parameters", "JSON with every parameter of every plugin, defaults included: the cell's identity", table=False
    ),
    Column(
        "solver_residual",
        "largest residual of the engine's constraint solver along rollouts, relative to the forces of a step",
        table=False,
    ),
    Column("wall_s", "seconds spent on the cell in total", "s", table=False),
    Column("stored_at", "time of storing, in seconds since 1970", "s", table=False),
    Column(
        "sequence",
        "counter of stored rows; of the rows of a key the one with the largest is the newest",
        table=False,
    ),
    text("machine", "processor, cores and system of the machine that measured the row", table=False),
    text(
        "reads", "JSON with the hash of every file, library and variable that code from outside has read", table=False
    ),
)
COMMON = {column.name: column for column in (*FIRST, DIM, *STATUS, *LAST, *HIDDEN)}


@dataclass(frozen=True)
class Columns:
    """The columns of a study's rows, in the order of its table."""

    all: tuple[Column, ...]
    by_name: dict[str, Column] = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "by_name", {column.name: column for column in self.all})

    @classmethod
    def of(cls, *own: Column) -> Columns:
        """Return the columns of a study: cell identity, status, reason, its ``own``, versions, key and hidden columns."""
        return cls((*FIRST, DIM, *STATUS, *own, *LAST, *HIDDEN))

    @classmethod
    def ordered(cls, names: Sequence[str], *own: Column) -> Columns:
        """Return the common and the ``own`` columns, first ``names`` in this order, then the others."""
        by_name = COMMON | {column.name: column for column in own}
        rest = [column for name, column in by_name.items() if name not in names]
        return cls((*(by_name[name] for name in names), *rest))

    @property
    def table(self) -> list[str]:
        """Names of the columns of the table."""
        return [column.name for column in self.all if column.table]

    @property
    def stored(self) -> list[str]:
        """Names of all columns of ``rows.parquet``."""
        return [column.name for column in self.all]

    @property
    def measured(self) -> list[str]:
        """Names of the columns that are missing if cells are not timed."""
        return [column.name for column in self.all if column.measured and not column.untimed]

    @property
    def compared(self) -> list[Column]:
        """The columns that ``compare`` compares."""
        return [column for column in self.all if column.comparison]

    @cached_property
    def vectors(self) -> frozenset[str]:
        """The columns of vectors that ``compare`` computes with."""
        rules = [column.comparison for column in self.compared if column.comparison is not None]
        return frozenset(name for rule in rules for name in (rule.mean, rule.reference) if name)

    def of_kind(self, kind: Kind) -> list[str]:
        """Return the names of the columns of one kind: ``number``, ``text`` or ``list``."""
        return [column.name for column in self.all if column.kind == kind]

    def blank(self) -> dict[str, Any]:
        """Return a row in which every value is missing: its default, or NaN, an empty string or an empty list."""
        empty: dict[Kind, Any] = {"text": "", "number": math.nan}
        return {c.name: empty.get(c.kind, []) if c.default is None else c.default for c in self.all}

    def typed(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return the table with its columns in order, of their types and derived, followed by unknown columns unchanged."""
        import pandas as pd

        known = {column.name: _typed(table.get(column.name), column, len(table)) for column in self.all}
        unknown = {name: table[name] for name in table if name not in self.by_name}
        return self.derive(pd.DataFrame({**known, **unknown}, index=table.index))

    def derive(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return the table with those of its columns that follow from others computed again."""
        return table.assign(**{c.name: c.derived for c in self.all if c.derived and c.name in table})


def _typed(values: pd.Series | None, column: Column, count: int) -> Any:
    """Return a column converted to the type of its kind; ``count`` missing values, or defaults, if ``values`` is None."""
    import pandas as pd

    kind = column.kind
    if values is None:
        if kind == "text":
            return pd.array([column.default or ""] * count, dtype="str")
        return np.full(count, math.nan if column.default is None else column.default)
    if column.default is not None:
        values = values.fillna(column.default)
    if kind == "number":
        return values if values.dtype == np.float64 else pd.to_numeric(values, errors="coerce").astype("float64")
    if kind == "text" and not (str(values.dtype) == "str" and values.notna().all()):
        return values.astype(object).fillna("").astype(str)
    return values.map(_numbers) if kind == "list" else values


def _numbers(listed: Any) -> Any:
    """Return a list with NaN where all its values are None, which is how Parquet stores a list of NaN."""
    is_object = isinstance(listed, np.ndarray) and listed.dtype == object and len(listed) > 0
    return np.full(len(listed), math.nan) if is_object and all(value is None for value in listed) else listed
