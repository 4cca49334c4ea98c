"""Measures one cell: by a search of its own where it is timed, else together with the cells that differ by seed only."""

from __future__ import annotations

from typing import Any

from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.studies.optimise.batched import measure_batched
from bench.studies.optimise.search import Settings, run_search


def measure(cell: Cell, session: Session, settings: Settings) -> dict[str, Any]:
    """Return the columns of one cell; untimed cells that differ by seed only share batches of rollouts."""
    return run_search(cell, session, settings) if cell.timing else measure_batched(cell, session, settings)
