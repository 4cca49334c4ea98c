"""Rows as tables: CSV with every digit, Markdown and LaTeX to read, and a digest for the terminal.

Also the arrangement that tables and charts share: rows along one swept axis (:func:`along`), one problem at a time
(:func:`families`), and in it one line per estimator with the backends that agree merged (:func:`lines`).
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.store import COLUMNS, IDENTITY, write_whole

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from bench.grid import Experiment

LABELS = ("scene", "contact", "integrator", "backend", "estimator_params")
"""Columns of identity strings, in which plugin parameters without a column of their own are found."""
CATEGORIES = ("scene", "contact", "integrator", "noise")
NUMBERS = ("horizon", "dt", "stiffness", "sigma", "smoothing", "samples", "repeats")
"""Numeric identity columns; with the categories they say which problem a row is."""
WHOLE = ("horizon", "samples", "repeats", "dim", "seed")
PROBLEM = ("scene", "contact", "integrator", "horizon", "dt", "stiffness", "sigma", "smoothing", "noise")
"""What rows must share for their times and errors to be comparable."""
UNITS = {"horizon": "steps", "dt": "s", "stiffness": "N/m", "kappa": "N m"}
REFUSED = ("unsupported", "unavailable")
"""Statuses of cells that were never run."""
EXACT, CLOSE = 1e-6, 1e-2
"""Relative difference below which backends count as giving the same numbers, and nearly the same."""
TIE = 1.1
"""Relative RMSEs within this factor of the lowest share the first place: R repeats do not resolve less."""
GOALS = (0.3, 0.1, 0.03)
"""Relative RMSEs to which the terminal names the fastest way."""
NEGLIGIBLE = 0.01
"""Relative bias below which the terminal does not remark on it."""
WIDTH = 100
FULL_ROWS = 40
"""Rows up to which the terminal shows each."""


# ----------------------------------------------------------------------------------- rows along an axis


def along(rows: pd.DataFrame, axis: str | None, experiment: Experiment) -> pd.DataFrame:
    """Rows that an axis applies to, its values in a new column ``x`` and nowhere else.

    The axis is a numeric column, a parameter in an identity string, or the parameter behind ``smoothing``. The
    identity string of a default leaves the parameter out: its value is then the one swept value seen in no string.
    Without an axis ``x`` is 0.
    """
    table = merge_seeds(rows)
    if axis is None:
        return table.assign(x=0.0)
    name = short_axis(axis)
    if name in NUMBERS or name == "seed":
        table = table.assign(x=table[name])
        if name != "seed":
            table[name] = math.nan
        return table[np.isfinite(table["x"])]
    pattern = re.compile(rf"(?:(?<=[\[,])|^){re.escape(name)}=([^,\]]*),?")
    values = swept_values(experiment, axis)
    for column in LABELS:
        found = table[column].str.extract(pattern, expand=False)
        if found.notna().any():
            x = pd.to_numeric(found, errors="coerce")
            base = table["estimator"] if column == "estimator_params" else table[column].str.partition("[")[0]
            unseen = [v for v in values if not np.isclose(x.dropna().astype(float), v, rtol=1e-9, atol=0.0).any()]
            if len(unseen) == 1:
                x = x.where(found.notna() | ~base.isin(set(base[found.notna()])), unseen[0])
            stripped = table[column].str.replace(pattern, "", regex=True)
            stripped = stripped.str.replace(r",(?=\]|$)", "", regex=True).str.replace("[]", "", regex=False)
            table = table.assign(x=x.astype(float), **{column: stripped})
            return table[np.isfinite(table["x"])]
    mine = [c for c, own in _smoothed(table, experiment).items() if own == axis]
    table = table[table["contact"].isin(mine)]
    return table.assign(x=table["smoothing"], smoothing=math.nan)


def short_axis(axis: str) -> str:
    """The parameter of a dotted axis name."""
    return axis.rpartition(".")[2]


def swept_values(experiment: Experiment, axis: str) -> list[float]:
    """The numbers an axis takes in the experiment's sweep."""
    from bench.grid import points

    found = dict.fromkeys(point[axis] for point in points(experiment.sweep) if axis in point)
    return [float(v) for v in found if isinstance(v, int | float) and not isinstance(v, bool)]


def _smoothed(table: pd.DataFrame, experiment: Experiment) -> dict[str, str]:
    """The swept axis behind the ``smoothing`` column of each contact law: the one that shares most values with it."""
    from bench.grid import swept

    axes = {axis: swept_values(experiment, axis) for axis in swept(experiment.sweep) if short_axis(axis) not in NUMBERS}
    found = {}
    for contact, part in table.groupby("contact"):
        values = part["smoothing"].dropna().unique()
        shared = {axis: int(np.isin(values, given).sum()) for axis, given in axes.items()}
        best = max(shared, key=lambda axis: shared[axis], default=None)
        if best is not None and shared[best] >= 2:
            found[str(contact)] = best
    return found


def numeric_axes(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> dict[str, int]:
    """The swept axes with at least two values in the rows, and how many; one of each parameter name."""
    found: dict[str, int] = {}
    for axis in axes:
        name = short_axis(axis)
        if name != "seed" and name not in (short_axis(a) for a in found):
            table = along(rows, axis, experiment)
            count = table["x"].nunique()
            if count > 1:
                found[axis] = count
    return found


def merge_seeds(rows: pd.DataFrame) -> pd.DataFrame:
    """One row per cell whatever the seed, medians over the seeds that ended well; ``lost`` counts those that did not."""
    rows = rows.assign(lost=((rows["status"] != "ok") & ~rows["status"].isin(REFUSED)).astype(float))
    if rows["seed"].nunique() < 2:
        return rows
    cell = rows.groupby([c for c in IDENTITY if c != "seed"], dropna=False, sort=False).ngroup()
    good = rows["status"] == "ok"
    merged = rows.assign(cell=cell, bad=~good).sort_values("bad", kind="stable").drop_duplicates("cell")
    merged = merged.set_index("cell").sort_index().drop(columns="bad")
    medians = rows[good].groupby(cell[good])[list(rows.select_dtypes("number").columns)].median()
    merged.loc[medians.index, medians.columns] = medians
    return merged.assign(lost=rows["lost"].groupby(cell).sum()).reset_index(drop=True)


# ------------------------------------------------------------------------------------- problem families


@dataclass(frozen=True, eq=False)
class Family:
    """The rows of one problem along an axis, and the identity columns that tell it from its neighbours."""

    identity: Mapping[str, Any]
    rows: pd.DataFrame

    def title(self) -> str:
        """``pushing, penalty, sigma=0.1``."""
        parts = [str(v) if k in CATEGORIES else f"{k}={axis_value(v)}" for k, v in self.identity.items()]
        return ", ".join(parts)


def families(table: pd.DataFrame, always: Sequence[str] = ()) -> list[Family]:
    """The problems of a table made by :func:`along`, in order of appearance; ``always`` are columns to name anyway.

    A numeric column splits problems when it varies at fixed ``x``; one that moves with ``x`` (a zipped axis) does not.
    """
    if table.empty:
        return []
    fixed = [*CATEGORIES, "backend", "dtype", "estimator", "estimator_params", "x"]
    varied = table.groupby(fixed, dropna=False)[list(NUMBERS)].nunique(dropna=False).max()
    keys = [*CATEGORIES, *(c for c in NUMBERS if varied[c] > 1)]
    groups = [(dict(zip(keys, key, strict=True)), part) for key, part in table.groupby(keys, dropna=False, sort=False)]
    telling: list[str] = []
    for key in keys:
        if key in always or _distinct(groups, [*telling, key]) > _distinct(groups, telling):
            telling.append(key)
    telling = telling or ["scene", "contact"]
    return [
        Family({k: i[k] for k in telling if _says_something(k, i[k])}, part.reset_index(drop=True))
        for i, part in groups
    ]


def _distinct(groups: Sequence[tuple[Mapping[str, Any], Any]], keys: Sequence[str]) -> int:
    return len({tuple(str(identity[k]) for k in keys) for identity, _ in groups})


def _says_something(column: str, value: Any) -> bool:
    return not (
        value == "none" or (column in NUMBERS and not math.isfinite(value)) or (column == "horizon" and not value)
    )


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
    failed: int

    @cached_property
    def at(self) -> dict[float, dict[str, Any]]:
        """The rows by ``x``."""
        return {float(x): row for x, row in zip(self.rows.index, self.rows.to_dict("records"), strict=True)}

    @property
    def label(self) -> str:
        """The estimator's identity string."""
        return f"{self.estimator}[{self.params}]" if self.params else self.estimator


def lines(rows: pd.DataFrame, exact: float = EXACT, close: float | None = CLOSE) -> list[Line]:
    """The lines of one family, in order of appearance; cells that were never run are left out.

    Backends within a relative difference of ``close`` are one line; each is its own without it.
    """
    rows = rows[~rows["status"].isin(REFUSED)]
    several = rows["dtype"].nunique() > 1
    found = []
    for (estimator, params), part in rows.groupby(["estimator", "estimator_params"], sort=False):
        runs: dict[str, pd.DataFrame] = {}
        for (backend, dtype), run in part.groupby(["backend", "dtype"], sort=False):
            name = f"{backend} {dtype}" if several else str(backend)
            runs[name] = run.drop_duplicates("x", keep="last").set_index("x").sort_index()
        while runs:
            first, mine = next(iter(runs.items()))
            merged = {first: True}
            if close is not None:
                merged = {name: agree(mine, run, exact) for name, run in runs.items() if agree(mine, run, close)}
            merged = dict(sorted(merged.items(), key=lambda item: not item[1]))
            seconds = {name: float(runs[name]["time_s"].median()) for name in merged}
            failed = sum(int(runs[name]["lost"].sum()) for name in merged)
            found.append(Line(str(estimator), str(params), merged, mine, seconds, failed))
            runs = {name: run for name, run in runs.items() if name not in merged}
    return found


def agree(a: pd.DataFrame, b: pd.DataFrame, tolerance: float) -> bool:
    """Whether two backends ended alike at every ``x`` and gave numbers within a relative tolerance."""
    if a is b:
        return True
    if not a.index.equals(b.index) or not (a["status"] == b["status"]).all():
        return False
    for name, scale in (("rmse", "rmse"), ("variance", "variance"), ("bias_high", "bias_high"), ("bias", "bias_high")):
        x, y = a[name].to_numpy(float), b[name].to_numpy(float)
        size = np.maximum(np.abs(a[scale].to_numpy(float)), np.abs(b[scale].to_numpy(float)))
        same = (x == y) | (np.isnan(x) & np.isnan(y))
        with np.errstate(invalid="ignore"):
            if not (same | (np.abs(x - y) <= tolerance * size)).all():
                return False
    return True


# ------------------------------------------------------------------------------------------- numbers as text


def number(value: float, digits: int = 2) -> str:
    """A number in few characters: ``0.021``, ``350``, ``1.2e5``; ``-`` for a missing one."""
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "inf" if value > 0 else "-inf"
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)
    if -4 < power < max(digits, 4):
        return f"{float(f'{value:.{digits - 1}e}'):.{max(digits - 1 - power, 0)}f}"
    return f"{mantissa}e{power}"


def axis_value(value: float) -> str:
    """A value on an axis: ``0.01``, ``3000``, ``1e4``."""
    if not math.isfinite(value):
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:g}"
    mantissa, exponent = f"{value:e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"


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


def resolved(row: Any) -> bool:
    """Whether the bias of a row can be told from 0."""
    return bool(row["bias_low"] > 0)


def relative(row: Any, column: str) -> float:
    """A column of a row in units of |grad J|; NaN where that is 0."""
    norm = row["reference_norm"]
    return float(row[column] / norm) if norm > 0 else math.nan


def _bias(row: Any, scale: Callable[[Any, str], float]) -> str:
    low, high = scale(row, "bias_low"), scale(row, "bias_high")
    if not resolved(row) and math.isfinite(high):
        return f"0 (< {number(high, 3)})" if high > 0 else "0"
    text = number(scale(row, "bias"), 3)
    return f"{text} [{number(low, 3)}, {number(high, 3)}]" if math.isfinite(low) and math.isfinite(high) else text


# --------------------------------------------------------------------------------------------------- files


def write(rows: pd.DataFrame, directory: Path) -> list[Path]:
    """Write ``bias_variance`` (.csv, .md, .tex) and ``speed_accuracy.csv``; returns their paths."""
    contents = {
        "bias_variance.csv": _csv(rows.reindex(columns=COLUMNS)),
        "bias_variance.md": markdown(rows),
        "bias_variance.tex": latex(rows),
        "speed_accuracy.csv": _csv(speed_accuracy(rows)),
    }
    for name, text in contents.items():
        write_whole(directory / name, text.encode())
    return [directory / name for name in contents]


def _csv(table: pd.DataFrame) -> str:
    table = table.copy()
    for name in WHOLE:
        if name in table and (table[name].dropna() % 1 == 0).all():
            table[name] = table[name].astype("Int64")
    return table.to_csv(index=False, lineterminator="\n")


def speed_accuracy(rows: pd.DataFrame) -> pd.DataFrame:
    """Error against time, with ``pareto`` where no other good row of the same problem is both faster and more accurate."""
    results = ["rmse_rel", "bias_rel", "time_s", "time_iqr_s", "compile_s", "rollouts", "gradients"]
    table = rows[["experiment", *IDENTITY, "status", *results]].copy()
    table["pareto"] = False
    good = table[(table["status"] == "ok") & np.isfinite(table["rmse_rel"]) & np.isfinite(table["time_s"])]
    for _, part in good.groupby(list(PROBLEM), dropna=False):
        table.loc[part.index[pareto(part["time_s"], part["rmse_rel"])], "pareto"] = True
    return table


def pareto(time: pd.Series, error: pd.Series) -> np.ndarray:
    """Mask of the points for which no other is smaller in both."""
    points = pd.DataFrame({"time": time.to_numpy(), "error": error.to_numpy()})
    best = points.groupby("time")["error"].min().cummin().shift(fill_value=math.inf)
    return (points["error"] <= points["time"].map(best)).to_numpy()


@dataclass(frozen=True)
class Readable:
    """The main table as text, not yet escaped for any format."""

    title: str
    shared: list[str]
    headers: list[str]
    body: list[list[str]]
    numeric: list[bool]
    footnotes: list[str]
    reasons: list[str]


def readable(rows: pd.DataFrame) -> Readable:
    """The main table: identity columns that vary, the results, and for what failed its status and reason."""
    varying = [c for c in IDENTITY if rows[c].nunique(dropna=False) > 1]
    problems = rows.groupby(["scene", "contact"], sort=False)
    main = ("scene", "contact", "backend", "estimator", "estimator_params")
    implied = [c for c in varying if c not in main and (problems[c].nunique(dropna=False) == 1).all()]
    shared = [f"The same in every row: {_named(rows.iloc[0], [c for c in IDENTITY if c not in varying])}."]
    for (scene, contact), part in problems if implied else ():
        problem = f"{scene}, {contact}" if contact != "none" else str(scene)
        shared.append(f"In every row of {problem}: {_named(part.iloc[0], implied)}.")
    varying = [c for c in varying if c not in implied]
    reasons = {text: i + 1 for i, text in enumerate(dict.fromkeys(r for r in rows["reason"] if r))}
    with_status = bool(reasons) or (rows["status"] != "ok").any()
    headers = [*varying, "bias [95% interval]", "relative bias", "variance", "rel. RMSE", "cosine", "time [ms]"]
    body = []
    for row in rows.to_dict("records"):
        cells = [row[c] if isinstance(row[c], str) else axis_value(row[c]) for c in varying]
        if row["status"] == "ok":
            cells += [_bias(row, lambda r, c: float(r[c])), _relative_bias(row), number(row["variance"], 3)]
            cells += [number(row["rmse_rel"], 3), number(row["cosine"], 3), number(row["time_s"] * 1e3, 3)]
        else:
            cells += ["-"] * 6
        if with_status:
            cells.append(row["status"] + (f" ({reasons[row['reason']]})" if row["reason"] else ""))
        body.append(cells)
    footnotes = [
        "0 (< u): the bias is not distinguishable from 0, its 95% interval reaches up to u.",
        "relative bias and rel. RMSE: divided by the norm of the reference gradient. A relative RMSE above 1 is worse "
        "than answering zero.",
        "variance: trace of the covariance of one estimate. time: one estimate, steady state, without compilation.",
    ]
    return Readable(
        title=f"{rows['experiment'].iloc[0]}: bias and variance",
        shared=shared,
        headers=[*headers, *(["status"] if with_status else [])],
        body=body,
        numeric=[*(c in NUMBERS or c == "seed" for c in varying), *([True] * 6), *([False] if with_status else [])],
        footnotes=footnotes,
        reasons=[f"({i}) {text}" for text, i in reasons.items()],
    )


def _named(row: Any, columns: Sequence[str]) -> str:
    texts = {c: row[c] if isinstance(row[c], str) else axis_value(row[c]) for c in columns}
    return ", ".join(f"{c} {text}" for c, text in texts.items() if text not in ("", "none", "-"))


def _relative_bias(row: Any) -> str:
    if not resolved(row):
        high = relative(row, "bias_high")
        return f"0 (< {number(high, 3)})" if high > 0 else "0" if high == 0 else "-"
    return number(row["bias_rel"], 3)


def markdown(rows: pd.DataFrame) -> str:
    """The main table in Markdown."""
    table, e = readable(rows), escape_markdown
    out = [f"# {e(table.title)}", ""]
    for text in table.shared:
        out += [e(text), ""]
    out.append("| " + " | ".join(map(e, table.headers)) + " |")
    out.append("|" + "|".join("--:" if right else "---" for right in table.numeric) + "|")
    out += ["| " + " | ".join(map(e, cells)) + " |" for cells in table.body]
    out += ["", *(f"- {e(note)}" for note in table.footnotes)]
    if table.reasons:
        out += ["", "Notes on the status:", "", *(f"- {e(reason)}" for reason in table.reasons)]
    return "\n".join(out) + "\n"


def latex(rows: pd.DataFrame) -> str:
    """The main table in LaTeX: a ``tabular`` of booktabs, or a ``longtable`` where it would not fit a page."""
    table, e = readable(rows), escape_latex
    long = len(table.body) > FULL_ROWS
    spec = "".join("r" if right else "l" for right in table.numeric)
    head = " & ".join(map(e, table.headers)) + r" \\"
    body = [" & ".join(map(e, cells)) + r" \\" for cells in table.body]
    notes = [e(text) for text in (table.title + ".", *table.shared, *table.footnotes, *table.reasons) if text]
    if long:
        out = [
            r"% needs \usepackage{booktabs,longtable}",
            r"\begingroup\footnotesize",
            rf"\begin{{longtable}}{{{spec}}}",
        ]
        out += [r"\toprule", head, r"\midrule", r"\endhead", r"\bottomrule", r"\endfoot", *body, r"\end{longtable}"]
    else:
        out = [r"% needs \usepackage{booktabs}", r"\begingroup\footnotesize", rf"\begin{{tabular}}{{{spec}}}"]
        out += [r"\toprule", head, r"\midrule", *body, r"\bottomrule", r"\end{tabular}", ""]
    out += [rf"\noindent {note}\par" for note in notes]
    return "\n".join([*out, r"\endgroup"]) + "\n"


def escape_markdown(text: str) -> str:
    """Text that a Markdown renderer shows as it stands, in a table cell too."""
    text = _one_line(text).replace("&", "&amp;")
    text = re.sub(r"<(?! )", "&lt;", text).replace(">", "&gt;")
    text = re.sub(r"([\\`*|$~])", r"\\\1", text).replace("](", r"]\(")
    return re.sub(r"(?<!\w)_|_(?!\w)", r"\\_", text)


def escape_latex(text: str) -> str:
    """Text that LaTeX prints as it stands."""
    special = {c: rf"\{c}" for c in "&%$#_{}"} | {
        "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$",
        "|": "$|$", "[": "{[}", "]": "{]}",
    }  # fmt: skip
    return "".join(special.get(c, c) for c in _one_line(text))


def _one_line(text: str) -> str:
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


# ------------------------------------------------------------------------------------------------ terminal


def show(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> None:
    """Print the question, the counts, the main table (condensed where it is long) and what follows from it."""
    from rich.console import Console

    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console = Console(highlight=False, markup=False, emoji=False, width=max(console.width, WIDTH))
    counts = rows["status"].value_counts()
    console.print(f"\n{experiment.name}: {experiment.question}" if experiment.question else f"\n{experiment.name}")
    console.print(f"{len(rows)} cells: " + ", ".join(f"{n} {status}" for status, n in counts.items()))
    parts = _parts(experiment, rows, axes)
    condensed = len(rows) > FULL_ROWS
    for axis, group in parts:
        if condensed and axis is not None:
            _show_family(console, group, axis)
        else:
            _show_rows(console, group, axis, merge=condensed)
    _show_legend(console, condensed=condensed and any(axis is not None for axis, _ in parts))
    _show_reasons(console, rows)
    console.print("\nIn short", style="bold")
    for axis, group in parts:
        _show_verdict(console, group, axis)


def _parts(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> list[tuple[str | None, Family]]:
    """The problems to print, each along the longest axis that it was swept along; every cell that ran is in one."""
    found = numeric_axes(experiment, rows, axes)
    parts: list[tuple[str | None, Family]] = []
    seen: set[str] = set()
    for axis in (*sorted(found, key=lambda a: -found[a]), None):
        for group in families(along(rows, axis, experiment), always=("scene", "contact")):
            ran = group.rows[~group.rows["status"].isin(REFUSED)]
            if set(ran["key"]) - seen and (axis is None or ran["x"].nunique() > 1):
                seen |= set(ran["key"])
                parts.append((axis, group))
    return parts


def _show_rows(console: Console, group: Family, axis: str | None, merge: bool) -> None:
    """One printed line per cell or, to ``merge``, per estimator and the backends that agree."""
    table = _table(group.title())
    if axis is not None:
        table.add_column(short_axis(axis), justify="right")
    for name in ("estimator", "backend"):
        table.add_column(name, overflow="fold")
    for name in ("rel. bias [95%]", "variance", "rel. RMSE", "cosine", "time"):
        table.add_column(name, justify="right")
    found = lines(group.rows) if merge else lines(group.rows, close=None)
    best = _best(found)
    for x in sorted({x for line in found for x in line.at}):
        for line in found:
            if x not in line.at:
                continue
            row = line.at[x]
            cells = [] if axis is None else [axis_value(x)]
            cells += [line.label, "\n".join(_backends(line))]
            if row["status"] != "ok":
                table.add_row(*cells, _styled(row["status"], "red"), "-", "-", "-", "-")
                continue
            times = line.seconds.values() if merge else [row["time_s"]]
            table.add_row(
                *cells, _bias(row, relative) + _noted(row), number(row["variance"]), _rmse(row, best.get(x, math.nan)),
                number(row["cosine"], 3), "\n".join(map(duration, times)),
            )  # fmt: skip
    console.print(table)


def _show_family(console: Console, group: Family, axis: str) -> None:
    """A pivot: two printed lines per estimator and agreeing backends, a column per value of the axis."""
    found = lines(group.rows)
    best = _best(found)
    values = sorted({x for line in found for x in line.at})
    room = max(1, (console.width - 44) // 8)
    for start in range(0, len(values), room):
        chunk = values[start : start + room]
        table = _table(f"{group.title()}   (columns: {axis_text(axis)})")
        width = min(60, max(34, console.width - 12 - 8 * len(chunk)))
        table.add_column("estimator, time", max_width=width, overflow="fold")
        table.add_column("", no_wrap=True)
        for x in chunk:
            table.add_column(axis_value(x), justify="right", no_wrap=True)
        table.add_column("fail", justify="right", no_wrap=True)
        for line in found:
            upper, lower = [], []
            for x in chunk:
                row = line.at.get(x)
                if row is None or row["status"] != "ok":
                    upper.append(_styled("" if row is None else row["status"][:6], "red"))
                    lower.append(_styled("", ""))
                    continue
                high = relative(row, "bias_high")
                text = number(relative(row, "bias")) if resolved(row) else f"<{number(high)}" if high > 0 else "0"
                upper.append(_styled(text + _noted(row), "yellow" if resolved(row) else "dim"))
                lower.append(_rmse(row, best.get(x, math.nan)))
            failed = str(line.failed) if line.failed else ""
            table.add_row(_styled(line.label, "bold"), "bias", *upper, failed)
            table.add_row(_timed_backends(line, width), "rmse", *lower, "")
        console.print(table)


def _table(title: str) -> Any:
    from rich.table import Table
    from rich.text import Text

    return Table(
        title=Text(f"\n{title}", style="bold"), title_justify="left", box=None, pad_edge=False, padding=(0, 2, 0, 0),
        header_style="underline",
    )  # fmt: skip


def _styled(text: str, style: str) -> Text:
    from rich.text import Text

    return Text(text, style=style)


def _noted(row: Any) -> str:
    return "?" if row["reason"] else ""


def _rmse(row: Any, best: float) -> Text:
    value = row["rmse_rel"]
    mark = "*" if value <= TIE * best else ""
    return _styled(number(value) + mark, "bold green" if mark and value < 1 else "red" if value >= 1 else "")


def _backends(line: Line) -> list[str]:
    return [("" if exact else "~") + name for name, exact in line.backends.items()]


def _timed_backends(line: Line, width: int) -> str:
    """``jax 0.21ms, torch 12ms``, broken between backends."""
    times = [duration(seconds).replace(" ", "") for seconds in line.seconds.values()]
    text = ", ".join(f"{name}\0{time}" for name, time in zip(_backends(line), times, strict=True))
    return textwrap.fill(text, width, initial_indent="  ", subsequent_indent="  ").replace("\0", " ")


def _best(found: Sequence[Line]) -> dict[float, float]:
    """The lowest relative RMSE at each ``x`` where there is one."""
    best: dict[float, float] = {}
    for x, row in sorted(((x, row) for line in found for x, row in line.at.items()), key=lambda item: item[0]):
        if row["status"] == "ok" and math.isfinite(row["rmse_rel"]):
            best[x] = min(row["rmse_rel"], best.get(x, math.inf))
    return best


def _show_legend(console: Console, condensed: bool) -> None:
    bias = (
        "'<u' when it cannot be told from 0 and lies below u" if condensed else "0 (< u) when it cannot be told from 0"
    )
    console.print(
        f"\nbias: |mean - reference| / |grad J|, {bias} (95%). rmse: error of one estimate / |grad J|, above 1 worse than "
        "answering zero; * lowest, within 10%. A ? is explained below. Backends on one line agree to 1e-6, with ~ to 1%."
        + (" Under each estimator: backends and their time per estimate. fail: cells not ok." if condensed else "")
    )


def _show_verdict(console: Console, group: Family, axis: str | None) -> None:
    """Of one problem: which estimators have the lowest error, whose error is bias, and which are useless, and where."""
    found = lines(group.rows)
    best = _best(found)
    winners: dict[float, list[str]] = {x: [] for x in best}
    biased: dict[str, dict[float, bool]] = {}
    useless: dict[str, dict[float, bool]] = {}
    for line in found:
        for x, row in line.at.items():
            good = row["status"] == "ok"
            if good and row["rmse_rel"] <= TIE * best.get(x, math.nan) and line.label not in winners[x]:
                winners[x].append(line.label)
            mostly = good and resolved(row) and row["bias_rel"] > NEGLIGIBLE and row["bias"] ** 2 > row["rmse"] ** 2 / 2
            for found_at, holds in ((biased, mostly), (useless, good and row["rmse_rel"] >= 1)):
                there = found_at.setdefault(line.label, {})
                there[x] = there.get(x, False) or holds
    console.print(f"  {group.title()}" + (f", by {axis_text(axis)}" if axis else ""), style="bold")
    sets = dict.fromkeys(", ".join(names) for names in winners.values())
    ranges = (f"{_range({x: ', '.join(n) == text for x, n in winners.items()})}: {text}" for text in sets)
    _print_wrapped(console, "lowest error: " + "; ".join(text.removeprefix(": ") for text in ranges), 4)
    for text, where in (("mostly bias, more samples do not help", biased), ("no better than answering zero", useless)):
        parts = [f"{label} {_range(holds)}".strip() for label, holds in where.items() if any(holds.values())]
        if parts:
            _print_wrapped(console, f"{text}: {', '.join(parts)}", 4)
    if axis is not None and short_axis(axis) == "samples":
        firsts: dict[str, list[str]] = {}
        for goal in GOALS:
            firsts.setdefault(_first(group.rows, goal), []).append(f"{goal:g}")
        parts = [f"{', '.join(goals)}: {first}" for first, goals in firsts.items()]
        _print_wrapped(console, f"first to a relative RMSE of {'; '.join(parts)}", 4)


def _first(rows: pd.DataFrame, goal: float) -> str:
    """The fastest cell with a relative RMSE of at most ``goal``."""
    good = rows[(rows["status"] == "ok") & (rows["rmse_rel"] <= goal) & np.isfinite(rows["time_s"])]
    if good.empty:
        return "none"
    row = good.loc[good["time_s"].idxmin()]
    label = f"{row['estimator']}[{row['estimator_params']}]" if row["estimator_params"] else row["estimator"]
    return f"{label} on {row['backend']} in {duration(row['time_s'])} with {row['x']:g} samples"


def _print_wrapped(console: Console, text: str, indent: int) -> None:
    lead = " " * indent
    console.print(textwrap.fill(text, console.width, initial_indent=lead, subsequent_indent=lead + "  "))


def _range(where: Mapping[float, bool]) -> str:
    """Where a finding holds along an axis: nothing for everywhere, ``<= 1000``, ``>= 1e4``, ``at 10, 100..3000``."""
    values = list(where)
    if all(where.values()):
        return ""
    runs: list[list[float]] = []
    for i, x in enumerate(values):
        if where[x]:
            if i and where[values[i - 1]]:
                runs[-1].append(x)
            else:
                runs.append([x])
    if len(runs) == 1 and len(runs[0]) > 1:
        if runs[0][0] == values[0]:
            return f"<={axis_value(runs[0][-1])}"
        if runs[0][-1] == values[-1]:
            return f">={axis_value(runs[0][0])}"
    texts = [axis_value(r[0]) if len(r) == 1 else f"{axis_value(r[0])}..{axis_value(r[-1])}" for r in runs]
    return f"at {' and '.join(texts)}"


def _show_reasons(console: Console, rows: pd.DataFrame) -> None:
    noted = rows[rows["reason"] != ""]
    if noted.empty:
        return
    console.print("\nFailed, refused or noted", style="bold")
    kinds = noted["reason"].str.replace(r"\d+(\.\d+)?(e[+-]?\d+)?", "#", regex=True)
    for (status, _), part in sorted(noted.groupby(["status", kinds]), key=lambda item: -len(item[1])):
        text = _one_line(part["reason"].iloc[0])
        more = "" if part["reason"].nunique() == 1 else " (for example)"
        _print_wrapped(console, f"{len(part)} {status}: {text}{more}", 2)
