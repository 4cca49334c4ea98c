"""Tables and charts that a notebook shows for an object."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping
from functools import partial
from html import escape

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

SIZE = (6.0, 3.4)
"""Width and height of a chart in inches."""
TITLE_WIDTH = 84
"""Characters of a line of a chart's title."""


def html_table(title: str, lines: Mapping[str, str]) -> str:
    """Return a title and a table of two columns, names and values, as HTML with all text escaped."""
    rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in lines.items())
    return f"<p><b>{escape(title)}</b></p><table>{rows}</table>"


def new_chart(title: str) -> tuple[Figure, Axes]:
    """Return a titled figure that a notebook shows, and its axes."""
    figure = Figure(figsize=SIZE, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    figure.suptitle(textwrap.fill(title, TITLE_WIDTH), fontsize=8, fontweight="bold")
    return displayable(figure), axes


def add_legend(figure: Figure) -> None:
    """Add a legend of one line below the axes, where it hides no data."""
    figure.legend(loc="outside lower center", ncols=4)


def displayable(figure: Figure) -> Figure:
    """Make a notebook show a figure that was made without pyplot; return the figure."""
    setattr(figure, "_repr_png_", partial(_png, figure))  # noqa: B010, Figure declares no such attribute
    return figure


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
