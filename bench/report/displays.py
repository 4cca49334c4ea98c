"""Makes figures visible in a notebook."""

from __future__ import annotations

import io
from functools import partial

from matplotlib.figure import Figure


def displayable(figure: Figure) -> Figure:
    """Make a notebook show a figure that was made without pyplot; return the figure."""
    setattr(figure, "_repr_png_", partial(_png, figure))  # noqa: B010, Figure declares no such attribute
    return figure


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
