"""Sets the style of figures and writes them as files."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image

from bench.report.style import STYLE
from bench.run.files import write_whole

DPI = 150
PLACES = 6
"""Decimal places of positions, in units of the figure."""
FONTS = ["DejaVu Sans", "Verdana"]
"""Fonts of one width: the one that texts are measured in, and one that most systems have."""
UNNEEDED = re.compile(r'<!--.*?-->\s*| *<metadata>.*?</metadata>\s*| id="[\w.]+_\d+"', re.DOTALL)
"""Parts of an SVG that nothing refers to: comments, metadata, and ids that count elements, the same in every figure."""
OPTIONS: dict[str, dict[str, Any]] = {
    "png": {"pil_kwargs": {"compress_level": 0}},
    "svg": {"metadata": {"Date": None}},
    "pdf": {"metadata": {"CreationDate": None}},
}
"""Options of each file format: metadata to omit because it would differ between equal figures, and no compression before the palette."""


@contextmanager
def styled() -> Iterator[None]:
    """Apply Matplotlib's defaults and the charts' style in a context; restore the user's settings afterwards."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)  # type: ignore[arg-type]
        yield


def save(figure: Figure, stem: Path, formats: Sequence[str] = ("png",), data: pd.DataFrame | None = None) -> list[Path]:
    """Write a figure as ``stem`` in some formats, and the plotted data, if given, as ``stem.plotted.csv``; return the paths.

    Equal figures give equal files: the files contain no dates, and places are rounded. Fonts are embedded, as outlines in SVG and as
    TrueType in PDF.
    """
    _settle(figure)
    contents = {}
    for suffix in formats:
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix, dpi=DPI, **OPTIONS[suffix])
        contents[suffix] = _with_palette(buffer) if suffix == "png" else buffer.getvalue()
    if data is not None:
        contents["plotted.csv"] = data.to_csv(index=False, lineterminator="\n", float_format="%.9g").encode()
    for suffix, content in contents.items():
        write_whole(stem.with_name(f"{stem.name}.{suffix}"), content)
    return [stem.with_name(f"{stem.name}.{suffix}") for suffix in contents]


def inline_svg(figure: Figure, name: str) -> str:
    """Return a figure as an SVG element for a page whose other elements have other names, without the title at its top.

    The ground is transparent and texts are texts, in a font as wide as the one they were measured in.
    """
    _settle(figure)
    title, width = figure.texts[0], figure.get_figwidth()
    below = Bbox.from_extents(0, 0, width, title.get_window_extent().y0 / figure.dpi)
    title.set_visible(False)
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": name, "svg.fonttype": "none", "font.sans-serif": FONTS}):
        figure.savefig(buffer, format="svg", transparent=True, bbox_inches=below, **OPTIONS["svg"])
    drawn = buffer.getvalue().decode()
    drawn = UNNEEDED.sub("", drawn[drawn.index("<svg") :])
    return re.sub(r' width="[^"]*" height="[^"]*"', f' style="--inches: {width:g}"', drawn, count=1)


def _settle(figure: Figure) -> None:
    """Compute the layout once, and round the places of axes to a hundredth of a pixel or less.

    The solver of constrained layouts orders its variables by their addresses in memory, so its results differ between runs
    in the last bits. Where a text is half a pixel from its neighbours, that would move it by a pixel.
    """
    if (engine := figure.get_layout_engine()) is not None:
        figure.set_dpi(DPI)
        engine.execute(figure)
        with styled():  # an engine, also one that does nothing, would draw the figure a second time
            figure.set_layout_engine(None)
    for axes in figure.axes:
        axes.set_position(Bbox(axes.get_position(original=True).get_points().round(PLACES)))


def _with_palette(png: io.BytesIO) -> bytes:
    """Return the PNG with a palette of 256 colours: a third of the size, without a visible difference."""
    image = Image.open(png).convert("RGB").quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    image.putpalette([255 if value >= 253 else value for value in image.getpalette() or ()])  # white stays white
    buffer = io.BytesIO()
    image.save(buffer, "png", optimize=True)
    return buffer.getvalue()
