"""Sets logarithmic axes with few labels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from bench.report.text import axis_value

TICKS = (
    (1, (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8)),
    (1, (1, 1.5, 2, 3, 5, 7)),
    (1, (1, 2, 5)),
    (1, (1, 3)),
    (1, (1,)),
    (2, (1,)),
    (3, (1,)),
    (4, (1,)),
    (6, (1,)),
    (10, (1,)),
)
"""Choices of ticks on a logarithmic axis, finest first: a stride in decades, and the positions within a decade."""

SMALLEST, LARGEST = 1e-250, 1e250
"""Limits of logarithmic axes: the margins that matplotlib adds must not overflow."""


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
    axis = getattr(panel, f"{which}axis")
    low, high = max(low, SMALLEST), min(high, LARGEST)
    getattr(panel, f"set_{which}scale")("log")
    getattr(panel, f"set_{which}lim")(low, high)
    ticks = list(wanted)
    if not ticks or high > 1e3 * low or np.diff(np.log10(ticks)).min(initial=math.inf) <= 0.15:
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
