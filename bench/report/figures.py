"""Figures drawn in the charts' own style and written as files."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from bench.report.plotted import plotted
from bench.report.style import STYLE
from bench.store import write_whole

METADATA: dict[str, dict[str, Any]] = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
"""What is left out of each kind of file, since it would differ between equal figures."""


@contextmanager
def styled() -> Iterator[None]:
    """Matplotlib's defaults and the charts' style on them, whatever the user's own settings; they come back after it."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)  # type: ignore[arg-type]
        yield


def save(figure: Figure, stem: Path) -> list[Path]:
    """Write ``stem.png``, ``.svg``, ``.pdf`` and ``.plotted.csv``, the plotted data; returns their paths.

    Equal figures are equal files: there are no dates in them. Fonts are embedded: as outlines in SVG, as TrueType in PDF.
    """
    contents = {"plotted.csv": plotted(figure).to_csv(index=False, lineterminator="\n", float_format="%.9g").encode()}
    for suffix, metadata in METADATA.items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix, dpi=150, metadata=metadata)
        contents[suffix] = buffer.getvalue()
    for suffix, content in contents.items():
        write_whole(stem.with_name(f"{stem.name}.{suffix}"), content)
    return [stem.with_name(f"{stem.name}.{suffix}") for suffix in (*METADATA, "plotted.csv")]
