"""Measures one cell: by a separate search if it is timed, else together with the cells that differ only in their seed."""

from __future__ import annotations

from typing import Any

from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.studies.optimise.batched import measure_batched
from bench.studies.optimise.search import Settings, run_search


def measure(cell: Cell, session: Session, settings: Settings) -> dict[str, Any]:
    """Return one cell's results by column. Untimed cells that differ only in their seed share batches of rollouts."""
    return run_search(cell, session, settings) if cell.timing else measure_batched(cell, session, settings)
