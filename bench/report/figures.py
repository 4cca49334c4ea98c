"""Sets the style of figures and writes them as files."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

from bench.report.plotted import plotted
from bench.report.style import STYLE
from bench.run.files import write_whole

METADATA: dict[str, dict[str, Any]] = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
"""Metadata to omit from each file format, because it would differ between equal figures."""


@contextmanager
def styled() -> Iterator[None]:
    """Apply Matplotlib's defaults and the charts' style in a context; restore the user's settings afterwards."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)  # type: ignore[arg-type]
        yield


def save(figure: Figure, stem: Path, formats: Sequence[str] = ("png",), data: pd.DataFrame | None = None) -> list[Path]:
    """Write a figure as ``stem`` in some formats, and its data as ``stem.plotted.csv``; return the files' paths.

    Equal figures give equal files, because the files contain no dates. Fonts are embedded, as outlines in SVG and as
    TrueType in PDF.
    """
    data = plotted(figure) if data is None else data
    contents = {"plotted.csv": data.to_csv(index=False, lineterminator="\n", float_format="%.9g").encode()}
    for suffix in formats:
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix, dpi=150, metadata=METADATA[suffix])
        contents[suffix] = _with_palette(buffer) if suffix == "png" else buffer.getvalue()
    for suffix, content in contents.items():
        write_whole(stem.with_name(f"{stem.name}.{suffix}"), content)
    return [stem.with_name(f"{stem.name}.{suffix}") for suffix in (*formats, "plotted.csv")]


def _with_palette(png: io.BytesIO) -> bytes:
    """Return the PNG with a palette of 256 colours: a third of the size, without a visible difference."""
    image = Image.open(png).convert("RGB").quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    image.putpalette([255 if value >= 253 else value for value in image.getpalette() or ()])  # white stays white
    buffer = io.BytesIO()
    image.save(buffer, "png", optimize=True)
    return buffer.getvalue()
