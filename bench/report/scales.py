"""Sets the axes of panels: logarithmic scales with few labels, shading, and marked values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from matplotlib.transforms import Affine2D, Transform, blended_transform_factory

from bench.report.style import MARKS, SHADE
from bench.report.text import axis_value
from bench.report.views import is_logarithmic

TICKS = (
    (1, (1, 1.5, 2, 3, 5, 7)), (1, (1, 2, 5)), (1, (1, 3)), (1, (1,)), (2, (1,)), (3, (1,)), (4, (1,)), (6, (1,)), (10, (1,))
)  # fmt: skip
"""Choices of ticks on a logarithmic axis, finest first: a stride in decades, and the positions within a decade."""

SMALLEST, LARGEST = 1e-290, 1e290
"""Limits of logarithmic axes: the margins that matplotlib adds must not overflow."""


def shifts(values: np.ndarray, count: int, columns: int) -> list[Affine2D]:
    """Return sideways shifts for ``count`` lines, smaller than the least distance of values, so that points do not overlap.

    They are applied before a panel's own transform: points move on paper, and their data are unchanged.
    """
    positions = np.log10(values) if is_logarithmic(values) else values
    step = min(0.4 * np.diff(positions).min(), 0.003 * columns * count * np.ptp(positions)) / max(count, 2)
    offsets = step * (np.arange(count) - (count - 1) / 2)
    return [Affine2D().scale(10**o, 1) if is_logarithmic(values) else Affine2D().translate(o, 0) for o in offsets]


def in_data(panel: Axes, artist: Line2D) -> bool:
    """Return whether both coordinates of an artist are data coordinates, shifted or not."""
    return bool(artist.get_transform().contains_branch(panel.transData))


def above(panel: Axes, place: Transform) -> Transform:
    """Return a transform with data in x, transformed by ``place``, and 0 to 1 from the panel's lower to upper edge in y."""
    return blended_transform_factory(place, panel.transAxes)


def scale_x(panel: Axes, values: np.ndarray) -> None:
    """Set the x scale of a swept axis, with ticks at its values if there are at most six."""
    if is_logarithmic(values):
        margin = (values.max() / values.min()) ** 0.07
        log_axis(panel, "x", values.min() / margin, values.max() * margin, values if len(values) <= 6 else ())
        return
    panel.set_xlim(values.min() - 0.07 * np.ptp(values), values.max() + 0.07 * np.ptp(values))
    if len(values) <= 6:
        panel.xaxis.set_major_locator(FixedLocator(list(values)))


def scale_y(panels: Sequence[Axes]) -> None:
    """Set one logarithmic y scale for all panels, with space for crosses, and shade errors above the gradient's norm."""
    low, high = extent(panels, "y", 0.3, 3.0)
    margin = (high / low) ** 0.12
    for panel in panels:
        log_axis(panel, "y", low / margin**1.5, high * margin)
        panel.axhspan(1.0, high * margin, zorder=0, **SHADE)
    for panel in panels[1:]:
        panel.tick_params(labelleft=False)


def log_axis(
    panel: Axes,
    which: str,
    low: float,
    high: float,
    wanted: Sequence[float] | np.ndarray = (),
    text: Callable[[float], str] | None = None,
) -> None:
    """Set a logarithmic axis from ``low`` to ``high`` with few labels.

    Ticks are at the values ``wanted`` if the axis spans at most three decades and they are not too close, else at round
    values. ``text`` formats the labels.
    """
    axis = panel.xaxis if which == "x" else panel.yaxis
    low, high = max(low, SMALLEST), min(high, LARGEST)
    getattr(panel, f"set_{which}scale")("log")
    getattr(panel, f"set_{which}lim")(low, high)
    ticks = list(wanted)
    if not ticks or high > 1e3 * low or np.diff(np.log10(ticks)).min() <= 0.15:
        words = 3 if text is not None else 4  # labels with a unit are wider than numbers
        ticks = _round_ticks(low, high, words if which == "x" else 5)
    if text is None:
        wide = which == "x" and len(ticks) > 3 and min(ticks) < 1e-2  # 0.001 and 0.01 would touch
        powers = (wide or any(not 1e-3 <= t <= 1e3 for t in ticks)) and all(
            f"{t:.1e}".startswith("1.0e") for t in ticks
        )
        text = _power if powers else axis_value
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FuncFormatter(lambda t, _: text(t)))
    axis.set_minor_locator(NullLocator())


def _round_ticks(low: float, high: float, most: int) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks: list[float] = []
    for stride, parts in TICKS:
        ticks = [part * 10.0**p for p in decades if p % stride == 0 for part in parts]
        ticks = [t for t in ticks if low <= t <= high]
        if len(ticks) <= most:
            break
    return ticks


def _power(value: float) -> str:
    return f"$10^{{{round(math.log10(value))}}}$"


def extent(panels: Iterable[Axes], which: str, low: float, high: float) -> tuple[float, float]:
    """Return the range of the positive data drawn in panels, extended to contain ``low`` and ``high``."""
    for panel in panels:
        for line in panel.lines:
            if in_data(panel, line):
                data = np.asarray(line.get_xdata() if which == "x" else line.get_ydata(), dtype=float)
                data = data[np.isfinite(data) & (data > 0)]
                low, high = min([low, *data]), max([high, *data])
    return float(low), float(high)


def mark_values(panel: Axes, marks: Mapping[str, float]) -> None:
    """Draw vertical lines at the named values of the x axis that are within its limits."""
    low, high = panel.get_xlim()
    for value, dashes in zip(marks.values(), MARKS * len(marks), strict=False):
        if low < value < high:
            panel.axvline(value, zorder=1, color="#595959", linewidth=0.9, linestyle=dashes)
