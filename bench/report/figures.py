"""Figures drawn in the charts' own style and written as files."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from bench.report.style import STYLE
from bench.store import write_whole


@contextmanager
def styled() -> Iterator[None]:
    """Matplotlib's defaults and the charts' style on them, whatever the user's own settings; they come back after it."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)  # type: ignore[arg-type]
        yield


def save(figure: Figure, stem: Path) -> list[Path]:
    """Write ``stem.png`` and ``stem.svg`` without dates, so that equal figures are equal files; returns their paths."""
    paths = []
    for suffix, metadata in (("png", {"Software": None}), ("svg", {"Date": None})):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix, dpi=150, metadata=metadata)
        paths.append(stem.with_name(f"{stem.name}.{suffix}"))
        write_whole(paths[-1], buffer.getvalue())
    return paths
