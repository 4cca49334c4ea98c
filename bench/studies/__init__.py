"""What is measured of a cell, and how it is shown: one study per file.

A study module has ``COLUMNS`` (:class:`~bench.store.Columns`), ``measure(cell, session) -> dict`` with the results of one
cell, and ``write(experiment, rows, axes) -> paths``, which writes its files and prints its table. Its name is its file's.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from bench.errors import unknown
from bench.grid import Cell, Experiment
from bench.session import Session
from bench.store import Columns

if TYPE_CHECKING:
    import pandas as pd


class Study(Protocol):
    """A study module."""

    COLUMNS: Columns

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Status, reason and the study's own columns for one cell."""

    def write(self, experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> list[Path]:
        """Files from rows; prints the table."""


def names() -> list[str]:
    """Names of the studies."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def find(name: str) -> Study:
    """The study of that name; raises :class:`~bench.errors.UserError` with the nearest name otherwise."""
    if name not in names():
        raise unknown("study", name, names())
    return cast(Study, importlib.import_module(f"{__name__}.{name}"))
