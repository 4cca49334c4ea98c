"""Rows as charts: bias and variance along each swept axis, error against time, and an overview where nothing is swept.

An estimator has one colour and marker in every chart, by its position among all registered estimators. Backends that
agree are one line. Relative means in units of the reference gradient's norm.
"""

from __future__ import annotations

import io
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.report.tables import (
    CATEGORIES,
    REFUSED,
    UNITS,
    Family,
    Line,
    along,
    axis_value,
    families,
    lines,
    numeric_axes,
    pareto,
    resolved,
    short_axis,
)
from bench.store import write_whole

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from bench.grid import Experiment

PALETTE = ("#0072B2", "#000000", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F6000")
"""Colours told apart by colour-blind readers (Okabe and Ito, yellow replaced by brown for white paper)."""
MARKERS = "osD^vPX*"
VARIANTS = ("-", (0, (4, 1.5)), (0, (1, 1.2)))
"""Line styles of one estimator's parameter variants."""
DEVIANT = ((0, (6, 1.5, 1, 1.5)), (0, (6, 1.5, 1, 1.5, 1, 1.5)), (0, (2, 2)))
"""Line styles of backends whose numbers differ from the first backend's."""
ALIKE = 0.03
"""Backends within this relative difference are one line: less could not be seen."""
WIDTH = 7.4
"""Inches of a page between its margins: fonts are printed at the size given here."""
COLUMNS = 4
FLOOR = 1e-4
"""Relative biases below this, and variances below its square, are drawn at the lower edge."""
STYLE: dict[str, Any] = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "figure.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.5,
    "legend.frameon": False,
    "svg.hashsalt": "bench",
}
SHADE: dict[str, Any] = {"color": "#d9d9d9", "alpha": 0.5, "linewidth": 0}
SYMBOLS = {
    "horizon": "horizon $T$ [steps]",
    "dt": r"time step $\Delta t$ [s]",
    "stiffness": "stiffness $k$ [N/m]",
    "sigma": r"noise $\sigma$",
    "smoothing": "smoothing",
    "samples": "samples $N$",
    "repeats": "repeats $R$",
    "beta": r"sharpness $\beta$",
    "kappa": r"central-path $\kappa$ [N m]",
}
SHORT = {
    "horizon": "$T$",
    "dt": r"$\Delta t$",
    "stiffness": "$k$",
    "sigma": r"$\sigma$",
    "samples": "$N$",
    "repeats": "$R$",
}


def write(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str], names: Sequence[str]) -> list[Path]:
    """Draw every chart that the rows can fill, as PNG and SVG; returns the files' paths.

    ``axes`` are the swept axes; ``names`` all registered estimators in the order that fixes their colours.
    """
    import matplotlib

    paths = []
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)  # type: ignore[arg-type]
        for name, figure in figures(experiment, rows, axes, names).items():
            figure.canvas.draw()
            figure.set_layout_engine("none")
            for suffix in ("png", "svg"):
                buffer = io.BytesIO()
                metadata = {"Software": None} if suffix == "png" else {"Date": None}
                figure.savefig(buffer, format=suffix, dpi=150, metadata=metadata)
                path = experiment.directory / f"{name}.{suffix}"
                write_whole(path, buffer.getvalue())
                paths.append(path)
    return paths


def figures(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str], names: Sequence[str]) -> dict[str, Figure]:
    """The charts by file name."""
    look = Look(rows, names)
    found: dict[str, Figure | None] = {}
    for axis in numeric_axes(experiment, rows, axes):
        name = re.sub(r"\W", "_", short_axis(axis))
        found[f"bias_variance_{name}"] = bias_variance(experiment, rows, axis, look)
    good = rows[rows["status"] == "ok"]
    if good["samples"].nunique() > 1 or good["backend"].nunique() > 1:
        found["speed_accuracy"] = speed_accuracy(experiment, rows, look)
    if not any(name.startswith("bias_variance") for name in found):
        found["overview"] = overview(experiment, rows, look)
    return {name: figure for name, figure in found.items() if figure is not None}


class Look:
    """The colour, marker and line style of every estimator and backend, the same in all charts."""

    def __init__(self, rows: pd.DataFrame, names: Sequence[str]) -> None:
        self._names = [*names, *sorted(set(rows["estimator"]) - set(names))]
        self._variants: dict[str, list[str]] = {}
        for estimator, params in rows[["estimator", "estimator_params"]].drop_duplicates().itertuples(index=False):
            self._variants.setdefault(estimator, []).append(params)
        for params_list in self._variants.values():
            params_list.sort()
        self._backends = list(dict.fromkeys(rows["backend"]))

    def colour(self, estimator: str) -> str:
        """The estimator's colour."""
        return PALETTE[self._names.index(estimator) % len(PALETTE)]

    def marker(self, estimator: str, params: str) -> str:
        """The marker of an estimator and its parameters."""
        place = self._names.index(estimator)
        return MARKERS[(place + place // len(PALETTE) + 3 * self._variant(estimator, params)) % len(MARKERS)]

    def dashes(self, estimator: str, params: str) -> Any:
        """The line style of an estimator and its parameters."""
        return VARIANTS[self._variant(estimator, params) % len(VARIANTS)]

    def backend_marker(self, backend: str) -> str:
        """The marker of a backend, in charts that tell backends apart."""
        return "os^DvPX*"[self._backends.index(backend) % 8]

    def _variant(self, estimator: str, params: str) -> int:
        known = self._variants.get(estimator, [])
        return known.index(params) if params in known else 0


# ------------------------------------------------------------------------------- bias and variance along an axis


def bias_variance(experiment: Experiment, rows: pd.DataFrame, axis: str, look: Look) -> Figure | None:
    """Relative bias above, relative variance below, against one axis; a column of panels per problem."""
    table = along(rows, axis, experiment)
    groups = [g for g in families(table) if _drawn(g.rows)["x"].nunique() > 1]
    chosen, held = choose(groups, COLUMNS)
    if not chosen:
        return None
    drawn = [lines(group.rows, exact=ALIKE, close=ALIKE) for group in chosen]
    blocks = math.ceil(len(chosen) / COLUMNS)
    columns = math.ceil(len(chosen) / blocks)
    marks = experiment.marks.get(axis, experiment.marks.get(short_axis(axis), {}))
    titles = _titles(chosen, 24)
    entries, symbols = _legend_entries(drawn, look, marks, short_axis(axis))
    figure, top = _page(
        max(WIDTH * columns / COLUMNS, 4.6), (3.4 + 0.15 * _tallest(titles)) * blocks, entries, symbols,
        f"Relative bias and variance along {_axis_symbol(axis)}",
        _subtitle(chosen, held, rows, short_axis(axis)),
    )  # fmt: skip
    grid = np.atleast_2d(top.subplots(2 * blocks, columns, squeeze=False))
    for index, found in enumerate(drawn):
        block, column = divmod(index, columns)
        upper, lower = grid[2 * block, column], grid[2 * block + 1, column]
        values = np.array(sorted({x for line in found for x in line.at}))
        shift = _shifts(values, len(found), columns)
        for place, line in enumerate(found):
            moved = {x: shift(x, place) for x in line.at}
            style = _style(line, found, look)
            _draw_errors(upper, line, moved, style, "bias", 1)
            _draw_errors(lower, line, moved, style, "variance", 2)
        upper.set_title(titles[index], pad=4)
        for panel in (upper, lower):
            _scale_x(panel, values)
            _mark_axis(panel, marks)
        lower.set_xlabel(_axis_symbol(axis))
        upper.tick_params(labelbottom=False)
        if column == 0:
            upper.set_ylabel("|bias| / |∇J|")
            lower.set_ylabel("variance / |∇J|²")
    for index in range(len(chosen), blocks * columns):
        block, column = divmod(index, columns)
        grid[2 * block, column].remove()
        grid[2 * block + 1, column].remove()
    together = len({group.rows["scene"].iloc[0] for group in chosen}) == 1
    for row in range(2 * blocks):
        panels = [panel for panel in grid[row] if panel.figure is not None]
        for place, part in enumerate([panels] if together else [[panel] for panel in panels]):
            _scale_y(part, place)
    return figure


def _axis_symbol(axis: str) -> str:
    return SYMBOLS.get(short_axis(axis), _plain(short_axis(axis)))


def _drawn(rows: pd.DataFrame) -> pd.DataFrame:
    return rows[~rows["status"].isin(REFUSED)]


def choose(groups: Sequence[Family], room: int) -> tuple[list[Family], dict[str, int]]:
    """The problems to draw where there are more than fit, and of every numeric column not drawn whole how many values.

    Every scene and contact law is drawn. Of its numeric columns the one with most values gets the room that leaves, at
    even ranks among the values that were run most and not at their ends; the others are held at a middle one of those.
    """
    if len(groups) <= room:
        return list(groups), {}
    kinds: dict[tuple[Any, ...], list[Family]] = {}
    for group in groups:
        kinds.setdefault(tuple(v for k, v in group.identity.items() if k in CATEGORIES), []).append(group)
    chosen = [group for members in kinds.values() for group in _thinned(members, groups, max(1, room // len(kinds)))]
    order = {id(group): place for place, group in enumerate(groups)}
    chosen.sort(key=lambda group: order[id(group)])
    every, drawn = (
        {k: {g.identity.get(k) for g in some} for g in groups for k in g.identity} for some in (groups, chosen)
    )
    return chosen, {k: len(every[k]) for k in every if k not in CATEGORIES and drawn[k] != every[k]}


def _thinned(members: Sequence[Family], groups: Sequence[Family], room: int) -> list[Family]:
    """The problems of one scene and contact law that :func:`choose` keeps."""

    def values(some: Iterable[Family], name: str) -> list[float]:
        return [float(group.identity.get(name, -math.inf)) for group in some]

    kept = list(members)
    numeric = {k for group in members for k in group.identity if k not in CATEGORIES}
    for name in sorted(numeric, key=lambda n: (-len(set(values(members, n))), n)):
        everywhere = Counter(values(groups, name))
        counts = {value: everywhere[value] for value in values(kept, name)}
        run_most = sorted(v for v, count in counts.items() if count == max(counts.values()))
        taken = min(room, len(run_most))
        wanted = {run_most[int((2 * i + 1) * len(run_most) / (2 * taken))] for i in range(taken)}
        kept = [group for group, value in zip(kept, values(kept, name), strict=True) if value in wanted]
        room //= taken
    return kept


def _draw_errors(
    panel: Axes, line: Line, moved: Mapping[float, float], style: dict[str, Any], column: str, power: int
) -> None:
    """One estimator's bias or variance: full markers with intervals, hollow ones with arrows at upper limits."""
    floor = FLOOR**power
    path: list[tuple[float, ...]] = []
    clear: list[tuple[float, ...]] = []
    limits: list[tuple[float, ...]] = []
    lost = []
    for x, row in line.at.items():
        value, low, high = _scaled(row, column, f"{column}_low", f"{column}_high", power=power)
        limit = column == "bias" and not resolved(row)
        value = high if limit else value
        good = row["status"] == "ok" and math.isfinite(value)
        if row["lost"] > 0 or not good:
            lost.append(moved[x])
        if not good:
            continue
        path.append((moved[x], max(value, floor)))
        if limit or value <= floor:
            limits.append(path[-1])
        else:
            clear.append(
                (*path[-1], value - max(low, floor) if low < value else 0.0, high - value if high > value else 0.0)
            )
    panel.plot(*_columns(path, 2), label=line.label, **{**style, "marker": "", "alpha": 0.75})
    mark: dict[str, Any] = {"color": style["color"], "marker": style["marker"], "linestyle": "none", "zorder": 3}
    if clear:
        xs, values, down, up = _columns(clear, 4)
        panel.errorbar(xs, values, yerr=[down, [u if math.isfinite(u) else 0.0 for u in up]], elinewidth=0.8, **mark)
    if limits:
        panel.plot(*_columns(limits, 2), **mark, markerfacecolor="white", markeredgewidth=0.9)
        _arrows(panel, limits, style["color"])
    if lost:
        height = 0.955 - 0.05 * (sum(other.get_marker() == "x" for other in panel.lines) % 4)
        panel.plot(
            lost, [height] * len(lost), transform=panel.get_xaxis_transform(), color=style["color"], marker="x",
            markersize=5, markeredgewidth=1.4, linestyle="none", clip_on=False, zorder=4,
        )  # fmt: skip


def _arrows(panel: Axes, points: Sequence[tuple[float, ...]], colour: str, down: bool = True) -> None:
    """Arrows from upper limits towards 0, of a fixed length on paper."""
    from matplotlib.path import Path as Outline

    ends = np.array([(0, -0.25), (0, -1), (-0.17, -0.78), (0, -1), (0.17, -0.78)])
    codes = [Outline.MOVETO, Outline.LINETO, Outline.MOVETO, Outline.LINETO, Outline.LINETO]
    arrow = Outline(ends if down else ends[:, ::-1], codes)
    outline: dict[str, Any] = {"marker": arrow, "markersize": 18, "markerfacecolor": "none", "markeredgewidth": 0.9}
    panel.plot(*_columns(points, 2), color=colour, linestyle="none", **outline)


def _scaled(row: Mapping[str, Any], *names: str, power: int = 1) -> tuple[float, ...]:
    """Columns in units of |grad J|, or as they are where that is 0."""
    norm = row["reference_norm"]
    scale = norm**power if math.isfinite(norm) and norm > 0 else 1.0
    return tuple(float(row.get(name, math.nan)) / scale for name in names)


def _columns(points: Sequence[tuple[float, ...]], width: int) -> list[list[float]]:
    return [[p[i] for p in points] for i in range(width)]


def _style(line: Line, found: Sequence[Line], look: Look) -> dict[str, Any]:
    """How a line is drawn; backends that differ from the estimator's first get a line style of their own."""
    twins = [other for other in found if other.label == line.label]
    place = twins.index(line)
    dashes = look.dashes(line.estimator, line.params) if place == 0 else DEVIANT[(place - 1) % len(DEVIANT)]
    return {
        "color": look.colour(line.estimator),
        "marker": look.marker(line.estimator, line.params),
        "linestyle": dashes,
    }


def _shifts(values: np.ndarray, count: int, columns: int) -> Callable[[float, int], float]:
    """Moves the points of line ``place`` of ``count`` sideways by a part of the smallest step, so that none hide others."""
    logarithmic = _logarithmic(values)
    positions = np.log10(values) if logarithmic else values
    step = float(np.diff(positions).min()) if len(values) > 1 else 1.0
    width = min(0.4 * step, 0.003 * columns * count * float(np.ptp(positions) or 1.0))

    def shift(x: float, place: int) -> float:
        offset = width * (place - (count - 1) / 2) / max(count, 2)
        return float(x * 10**offset) if logarithmic else float(x + offset)

    return shift


def _logarithmic(values: np.ndarray) -> bool:
    return bool(len(values) and values.min() > 0 and values.max() >= 8 * values.min())


def _scale_x(panel: Axes, values: np.ndarray) -> None:
    from matplotlib.ticker import FixedLocator

    if _logarithmic(values):
        margin = (values.max() / values.min()) ** 0.07
        _log_axis(panel, "x", values.min() / margin, values.max() * margin, values if len(values) <= 6 else None)
    else:
        margin = 0.07 * float(np.ptp(values))
        panel.set_xlim(values.min() - margin, values.max() + margin)
        if len(values) <= 6:
            panel.xaxis.set_major_locator(FixedLocator(list(values)))


TICKS = (
    (1, (1, 1.5, 2, 3, 5, 7)), (1, (1, 2, 5)), (1, (1, 3)), (1, (1,)), (2, (1,)), (3, (1,)), (4, (1,)), (6, (1,)), (10, (1,))
)  # fmt: skip
"""Choices of ticks on a logarithmic axis, finest first: every how many decades, and where in a decade."""


def _log_axis(
    panel: Axes,
    which: str,
    low: float,
    high: float,
    wanted: np.ndarray | None = None,
    text: Callable[[float], str] = axis_value,
) -> None:
    """A logarithmic axis from ``low`` to ``high`` with few labels: ``wanted`` ones if near each other, or round ones."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    axis = panel.xaxis if which == "x" else panel.yaxis
    getattr(panel, f"set_{which}scale")("log")
    getattr(panel, f"set_{which}lim")(low, high)
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks: list[float] = []
    if wanted is not None and len(decades) <= 4 and min(np.diff(np.log10(wanted)), default=1.0) > 0.15:
        ticks = [float(v) for v in wanted]
    else:
        for stride, parts in TICKS:
            ticks = [part * 10.0**p for p in decades if p % stride == 0 for part in parts]
            ticks = [t for t in ticks if low <= t <= high]
            if len(ticks) <= (4 if which == "x" else 5):
                break
    powers = (
        text is axis_value
        and any(not 1e-3 <= t <= 1e3 for t in ticks)
        and all(f"{t:.1e}".startswith("1.0e") for t in ticks)
    )
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FuncFormatter(lambda t, _: f"$10^{{{round(math.log10(t))}}}$" if powers else text(t)))
    axis.set_minor_locator(NullLocator())


def _scale_y(panels: Sequence[Axes], place: int) -> None:
    """One logarithmic scale for panels, with room for crosses, and shade where the error exceeds the gradient."""
    low, high = _extent(panels, "y", 0.3, 3.0)
    margin = (high / low) ** 0.12
    for panel in panels:
        _log_axis(panel, "y", low / margin**1.5, high * margin)
        panel.axhspan(1.0, high * margin, zorder=0, **SHADE)
        if panel is not panels[0]:
            panel.tick_params(labelleft=False)


def _extent(panels: Iterable[Axes], which: str, low: float, high: float) -> tuple[float, float]:
    """The range of the points drawn in panels, widened to contain ``low`` to ``high``."""
    for panel in panels:
        for line in panel.lines:
            if line.get_transform() == panel.transData:
                data = np.asarray(line.get_xdata() if which == "x" else line.get_ydata(), dtype=float)
                data = data[np.isfinite(data) & (data > 0)]
                low, high = min([low, *data]), max([high, *data])
    return float(low), float(high)


def _mark_axis(panel: Axes, marks: Mapping[str, float]) -> None:
    low, high = panel.get_xlim()
    for place, value in enumerate(marks.values()):
        if low < value < high:
            panel.axvline(value, zorder=1, **_mark_style(place))


def _mark_style(place: int) -> dict[str, Any]:
    return {
        "color": "#595959",
        "linewidth": 0.9,
        "linestyle": [(0, (3, 2)), (0, (1, 1.5)), (0, (5, 1, 1, 1))][place % 3],
    }


# ------------------------------------------------------------------------------------------- error against time


def speed_accuracy(experiment: Experiment, rows: pd.DataFrame, look: Look) -> Figure | None:
    """Relative RMSE of one estimate against its time, a panel per problem, a curve per estimator and backend."""
    from matplotlib.lines import Line2D

    groups = [g for g in families(along(rows, "samples", experiment)) if len(_timed(g.rows)) > 1]
    chosen, held = choose(groups, COLUMNS)
    if not chosen:
        return None
    columns = min(len(chosen), 2 if len(chosen) in (2, 4) else 3)
    blocks = math.ceil(len(chosen) / columns)
    drawn = [lines(group.rows, close=None) for group in chosen]
    entries = {
        line.label: Line2D([], [], label=_plain(line.label), **_curve(line, look)) for found in drawn for line in found
    }
    backends = dict.fromkeys(name for found in drawn for line in found for name in line.backends)
    symbols = [
        Line2D([], [], color="#404040", marker=look.backend_marker(name), linestyle="none", label=_plain(name))
        for name in backends
    ]
    symbols += [
        Line2D([], [], color="#bdbdbd", linewidth=3, label="Pareto front"),
        _shade_entry("worse than answering zero"),
    ]
    samples = sorted({int(x) for found in drawn for line in found for x in line.at})
    subtitle = _subtitle(chosen, held, rows, "samples")
    if len(samples) > 1:
        along_curve = f"along a curve $N$ = {', '.join(map(str, samples))}".replace(", ", " | ")
        subtitle = ", ".join(filter(None, [subtitle, along_curve]))
    figure, top = _page(
        WIDTH if columns > 1 else 4.6, 2.7 * blocks, list(entries.values()), symbols,
        "Relative RMSE of one estimate against the time it takes", subtitle.replace(" | ", ", "),
    )  # fmt: skip
    titles = _titles(chosen, 30 if columns == 3 else 44)
    grid = top.subplots(blocks, columns, squeeze=False)
    for index, panel in enumerate(grid.flat):
        if index >= len(chosen):
            panel.remove()
            continue
        for line in drawn[index]:
            _draw_curve(panel, line, look)
        _draw_front(panel, _timed(chosen[index].rows))
        panel.set_title(titles[index], pad=4)
        if index // columns == blocks - 1 or index + columns >= len(chosen):
            panel.set_xlabel("time of one estimate")
        if index % columns == 0:
            panel.set_ylabel("relative RMSE")
    return figure


def _seconds(value: float) -> str:
    unit, factor = next(((u, f) for u, f in (("s", 1.0), ("ms", 1e3), ("µs", 1e6)) if value * f >= 0.9999), ("ns", 1e9))
    return f"{value * factor:.4g} {unit}"


def _timed(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows that have a point in a chart of error against time."""
    good = (rows["status"] == "ok") & np.isfinite(rows["rmse_rel"]) & np.isfinite(rows["time_s"])
    return rows[good & (rows["rmse_rel"] > 0) & (rows["time_s"] > 0)]


def _curve(line: Line, look: Look) -> dict[str, Any]:
    return {"color": look.colour(line.estimator), "linestyle": look.dashes(line.estimator, line.params)}


def _draw_curve(panel: Axes, line: Line, look: Look) -> None:
    rows = _timed(line.rows)
    backend = line.rows["backend"].iloc[0]
    spread = np.nan_to_num(rows["time_iqr_s"].to_numpy() / 2)
    time = rows["time_s"].to_numpy()
    panel.errorbar(
        time, rows["rmse_rel"], xerr=[np.minimum(spread, 0.9 * time), spread], elinewidth=0.7, label=line.label,
        marker=look.backend_marker(backend), **_curve(line, look),
    )  # fmt: skip


def _draw_front(panel: Axes, rows: pd.DataFrame) -> None:
    """The Pareto front as a step line from the fastest point down to the most accurate, and the panel's scales."""
    front = rows[pareto(rows["time_s"], rows["rmse_rel"])].sort_values(["time_s", "rmse_rel"])
    low, high = rows["rmse_rel"].min(), rows["rmse_rel"].max()
    spread = np.minimum(rows["time_iqr_s"].fillna(0.0) / 2, rows["time_s"] / 2)
    first, last = (rows["time_s"] - spread).min(), (rows["time_s"] + spread).max()
    tall, wide = max(high / low, 4.0) ** 0.08, max(last / first, 4.0) ** 0.08
    _log_axis(panel, "x", first / wide, last * wide, text=_seconds)
    _log_axis(panel, "y", low / tall, high * tall)
    if high * tall > 1:
        panel.axhspan(1.0, high * tall, zorder=0, **SHADE)
    x = [front["time_s"].iloc[0], *front["time_s"], panel.get_xlim()[1]]
    y = [panel.get_ylim()[1], *front["rmse_rel"], front["rmse_rel"].iloc[-1]]
    panel.step(
        x, y, where="post", color="#bdbdbd", linewidth=3, zorder=0.5, solid_capstyle="butt", label="Pareto front"
    )


# ---------------------------------------------------------------------------------------------------- overview


def overview(experiment: Experiment, rows: pd.DataFrame, look: Look) -> Figure | None:
    """Relative bias and RMSE of every estimator, a panel per problem."""
    from matplotlib.lines import Line2D

    groups = [g for g in families(along(rows, None, experiment)) if len(_drawn(g.rows))]
    if not groups:
        return None
    drawn = [lines(group.rows, exact=ALIKE, close=ALIKE) for group in groups]
    labels = list(dict.fromkeys(_row_label(line, found) for found in drawn for line in found))
    columns = min(len(groups), 2 if len(groups) == 4 else 3)
    titles = _titles(groups, 26 if columns == 3 else 44)
    blocks = math.ceil(len(groups) / columns)
    grey: dict[str, Any] = {"color": "#404040", "linestyle": "none"}
    symbols = [
        Line2D([], [], **grey, marker="o", label="relative bias, 95% interval"),
        Line2D([], [], **grey, marker="o", markerfacecolor="white", label="not distinguishable from 0"),
        Line2D([], [], **grey, marker="|", markersize=9, markeredgewidth=2, label="relative RMSE"),
    ]
    symbols.append(_shade_entry("error exceeds |∇J|"))
    if any(line.failed for found in drawn for line in found):
        symbols.append(Line2D([], [], **grey, marker="x", markeredgewidth=1.4, label="cell failed"))
    figure, top = _page(
        WIDTH, (0.55 + 0.15 * _tallest(titles) + 0.24 * len(labels)) * blocks, [], symbols, "Relative bias and RMSE of one estimate",
        _subtitle(groups, {}, rows, ""),
    )  # fmt: skip
    grid = top.subplots(blocks, columns, squeeze=False, sharey=True)
    for index, panel in enumerate(grid.flat):
        if index >= len(groups):
            panel.remove()
            continue
        for line in drawn[index]:
            _draw_dot(panel, line, len(labels) - 1 - labels.index(_row_label(line, drawn[index])), look)
        _scale_dots(panel)
        panel.set_ylim(-0.6, len(labels) - 0.4)
        panel.set_yticks(range(len(labels)), [_plain(label) for label in reversed(labels)])
        panel.tick_params(axis="y", length=0)
        panel.set_title(titles[index], pad=4)
        if index + columns >= len(groups):
            panel.set_xlabel("in units of |∇J|")
    return figure


def _row_label(line: Line, found: Sequence[Line]) -> str:
    alone = sum(other.label == line.label for other in found) == 1
    return line.label if alone else f"{line.label}, {'/'.join(line.backends)}"


def _draw_dot(panel: Axes, line: Line, height: int, look: Look) -> None:
    colour = look.colour(line.estimator)
    panel.axhline(height, color="#e5e5e5", linewidth=0.6, zorder=0)
    for _, row in line.at.items():
        value, low, high, error = _scaled(row, "bias", "bias_low", "bias_high", "rmse")
        if row["lost"] > 0 or not math.isfinite(error):
            panel.plot(
                [0.97], [height], transform=panel.get_yaxis_transform(), color=colour, marker="x", markeredgewidth=1.4
            )
        if row["status"] != "ok" or not math.isfinite(error):
            continue
        mark: dict[str, Any] = {"color": colour, "marker": "o", "linestyle": "none"}
        if resolved(row) and value > FLOOR:
            bars = np.nan_to_num([[max(value - max(low, FLOOR / 10), 0)], [max(high - value, 0)]])
            panel.errorbar([value], [height], xerr=bars, elinewidth=1.0, label=line.label, **mark)
        else:
            limit = (max(high if math.isfinite(high) else FLOOR, FLOOR), height)
            panel.plot([limit[0]], [height], markerfacecolor="white", label=line.label, **mark)
            _arrows(panel, [limit], colour, down=False)
        panel.plot(
            [max(error, FLOOR)], [height], color=colour, marker="|", markersize=9, markeredgewidth=2, linestyle="none"
        )


def _scale_dots(panel: Axes) -> None:
    low, high = _extent([panel], "x", 0.3, 2.0)
    margin = (high / low) ** 0.08
    _log_axis(panel, "x", low / margin**2, high * margin)
    panel.axvspan(1.0, high * margin, zorder=0, **SHADE)


# ------------------------------------------------------------------------------------------ titles and legends


def _page(
    width: float, height: float, entries: Sequence[Any], symbols: Sequence[Any], title: str, subtitle: str
) -> tuple[Figure, SubFigure]:
    """A figure with a title, room for panels ``height`` inches high, and legends below them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    columns = [_legend_columns(part, width) for part in (entries, symbols)]
    rows = [math.ceil(len(part) / count) for part, count in zip((entries, symbols), columns, strict=True)]
    below = 0.165 * sum(rows) + 0.1
    subtitle = _wrapped(subtitle, int(width * 17))
    above = 0.25 + 0.16 * (subtitle.count("\n") + 1)
    layout = ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03, rect=(0.005, 0, 0.99, 1))
    figure = Figure(figsize=(width, above + height + below), layout=layout)
    FigureCanvasAgg(figure)
    head, top, bottom = figure.subfigures(3, 1, height_ratios=[above, height, below], squeeze=False)[:, 0]
    head.text(0.5, 1 - 0.07 / above, title, ha="center", va="top", fontsize=9, fontweight="bold")
    head.text(0.5, 1 - 0.25 / above, subtitle, ha="center", va="top", color="#404040")
    for part, count, place, anchor in (
        (entries, columns[0], "upper center", 1.0), (symbols, columns[1], "lower center", 0.0)
    ):  # fmt: skip
        if part:
            bottom.legend(
                handles=list(part), loc=place, bbox_to_anchor=(0.5, anchor), ncols=count, borderpad=0.1,
                labelspacing=0.25, handletextpad=0.5, columnspacing=1.2, borderaxespad=0.1,
            )  # fmt: skip
    return figure, top


def _legend_columns(entries: Sequence[Any], width: float) -> int:
    """The most columns, at most four, in which legend entries fit ``width`` inches; they fill column after column."""
    lengths = [0.55 + 0.066 * _length(entry.get_label()) for entry in entries]
    for count in range(min(4, len(lengths)), 1, -1):
        rows = math.ceil(len(lengths) / count)
        if sum(max(lengths[i : i + rows]) for i in range(0, len(lengths), rows)) <= width:
            return count
    return 1


def _legend_entries(
    drawn: Sequence[Sequence[Line]], look: Look, marks: Mapping[str, float], axis: str
) -> tuple[list[Any], list[Any]]:
    """Legend handles: estimators, then the meaning of symbols."""
    from matplotlib.lines import Line2D

    estimators: dict[str, Any] = {}
    deviants: dict[int, list[str]] = {}
    failed = hollow = False
    for found in drawn:
        for line in found:
            style = _style(line, [line], look)
            estimators.setdefault(line.label, Line2D([], [], label=_plain(line.label), **style))
            place = [other for other in found if other.label == line.label].index(line)
            if place:
                deviants.setdefault(place, []).extend(line.backends)
            failed |= any(row["lost"] > 0 for row in line.at.values())
            hollow |= any(not resolved(row) for row in line.at.values() if row["status"] == "ok")
    grey: dict[str, Any] = {"color": "#404040"}
    symbols: list[Any] = []
    for place, names in deviants.items():
        text = f"{', '.join(dict.fromkeys(names))}, where different"
        symbols.append(Line2D([], [], **grey, linestyle=DEVIANT[(place - 1) % len(DEVIANT)], label=_plain(text)))
    if hollow:
        text = "bias not distinguishable from 0: 95% limit"
        symbols.append(Line2D([], [], **grey, marker="o", markerfacecolor="white", linestyle="none", label=text))
    if failed:
        symbols.append(Line2D([], [], **grey, marker="x", markeredgewidth=1.4, linestyle="none", label="cell failed"))
    symbols.append(_shade_entry("error exceeds |∇J|"))
    for place, (text, value) in enumerate(marks.items()):
        label = f"{_plain(text)}, {_short(axis)} = {_quantity(value, axis)}"
        symbols.append(Line2D([], [], **_mark_style(place), label=label))
    return list(estimators.values()), symbols


def _shade_entry(text: str) -> Any:
    from matplotlib.patches import Patch

    return Patch(label=text, **SHADE)


def _titles(groups: Sequence[Family], width: int) -> list[str]:
    """Titles of panels, all broken before their numbers where one of them is too long for a line."""
    parts = [_title(group) for group in groups]
    if all(_length(", ".join(filter(None, part))) <= width for part in parts):
        return [", ".join(filter(None, part)) for part in parts]
    return ["\n".join(_wrapped(text, width) for text in part if text) for part in parts]


def _tallest(titles: Sequence[str]) -> int:
    return max(title.count("\n") for title in titles)


def _title(group: Family) -> tuple[str, str]:
    """What tells a problem apart: its scene, contact law and the like, and its numbers."""
    kinds = [_plain(str(value)) for name, value in group.identity.items() if name in CATEGORIES]
    numbers = [f"{_short(k)} = {_quantity(v, k)}" for k, v in group.identity.items() if k not in CATEGORIES]
    if not (group.rows["reference_norm"].dropna() > 0).any():
        numbers.append("absolute: ∇J = 0")
    return ", ".join(kinds), ", ".join(numbers)


def _short(name: str) -> str:
    return SHORT.get(name, name)


def _quantity(value: float, name: str) -> str:
    text = axis_value(value)
    mantissa, _, power = text.partition("e")
    if power:
        text = f"$10^{{{power}}}$" if mantissa == "1" else rf"${mantissa}\times 10^{{{power}}}$"
    return f"{text} {UNITS[name]}" if name in UNITS else text


def _subtitle(chosen: Sequence[Family], held: Mapping[str, int], rows: pd.DataFrame, axis: str) -> str:
    """What the panels' titles leave out: what is the same in all, and which other values were run but not drawn."""
    shown = {name: len({group.identity.get(name) for group in chosen}) for name in held}
    told = {axis, *held, *(name for group in chosen for name in group.identity)}
    parts = []
    for name in ("scene", "contact"):
        values = {str(v) for group in chosen for v in group.rows[name].unique()}
        if name not in told and len(values) == 1 and values != {"none"}:
            parts.append(_plain(*values))
    for name in ("stiffness", "sigma", "horizon", "samples", "repeats"):
        numbers = {float(v) for group in chosen for v in group.rows[name].fillna(0.0).unique()}
        if name not in told and len(numbers) == 1 and numbers != {0.0}:
            parts.append(f"{_short(name)} = {_quantity(numbers.pop(), name)}")
    for name, count in held.items():
        parts.append(f"{shown[name]} of {count} values of {_short(name)} shown")
    seeds = rows["seed"].nunique()
    if seeds > 1:
        parts.append(f"medians over {seeds} seeds")
    return ", ".join(parts)


def _plain(text: str) -> str:
    """Text that is not taken for a formula, nor left out of a legend for its underscore."""
    text = " ".join(text.split()).replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def _length(text: str) -> int:
    """Letters of a text as printed, formulas counted as two."""
    return len(re.sub(r"(?<!\\)\$.*?(?<!\\)\$", "xx", text))


def _wrapped(text: str, width: int = 26) -> str:
    """Lines of at most ``width`` characters where there are commas to break at."""
    out: list[str] = []
    for part in text.split(", "):
        if out and _length(out[-1]) + _length(part) + 2 <= width:
            out[-1] += f", {part}"
        else:
            out.append(part)
    return ",\n".join(out)
