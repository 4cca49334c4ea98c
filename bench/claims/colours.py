"""Colours of estimators, and points with 95% intervals, for the charts of claims."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.report.colours import estimator_colour
from bench.report.style import GREY

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["GREY", "bars", "estimator_colour"]


def bars(axes: Axes, x: Sequence[float], measured: Sequence[tuple[float, float]], **look: Any) -> None:
    """Draw points with 95% intervals. ``measured`` contains pairs of a mean and its standard error.

    On a logarithmic axis an interval that reaches 0 ends at a tenth of its mean.
    """
    y, error = np.asarray(measured, dtype=float).T
    down, up = 1.96 * error, 1.96 * error
    if axes.get_yscale() == "log":
        down = np.minimum(down, 0.9 * y)
    axes.errorbar(x, y, yerr=(down, up), capsize=2, elinewidth=0.8, **look)
