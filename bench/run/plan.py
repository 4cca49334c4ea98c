"""Plans a run: which cells are stored, which are refused, and which have to be run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.grid import cells
from bench.experiment.study import study_of
from bench.model import Backend, Plugin, guard
from bench.model.parameters import remember
from bench.run.store import Store

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Planned:
    """A cell, and whether it is stored already, refused or due to run."""

    cell: Cell
    stored: bool
    refusal: tuple[str, str] | None
    aged: str = ""
    """Library versions that made the stored row, if they differ from the installed ones."""
    machine: str = ""
    """The kind of machine that timed the stored row."""

    @property
    def runs(self) -> bool:
        """Whether the cell has to be simulated."""
        return not self.stored and self.refusal is None


def plan(experiment: Experiment, store: Store) -> list[Planned]:
    """Return every cell of the experiment in order, with its state; raises :class:`UserError` for a bad one."""
    rows = store.load()
    facts = zip(rows["status"], rows["versions"], rows["machine"], strict=True)
    stored = dict(zip(rows["key"], facts, strict=True))
    with guard.capture_output("a plugin"), guard.protect_process():
        return [_planned(experiment, cell, stored) for cell in cells(experiment)]


def _planned(experiment: Experiment, cell: Cell, stored: dict[str, tuple[str, str, str]]) -> Planned:
    refusal = cell.refusal() or _refused(experiment, cell)
    if cell.key not in stored:
        return Planned(cell, False, refusal)
    status, made_by, machine = stored[cell.key]
    rules = experiment.execution
    aged = made_by if rules.versions != "ignore" and status == "ok" and made_by != versions(cell.backend) else ""
    again = status in rules.retry or (bool(aged) and rules.versions == "rerun")
    # a plugin that was missing when the row was stored is there now
    installed = status == "unavailable" and refusal is None
    timed = machine if cell.timing and status == "ok" and not again else ""
    return Planned(cell, not (again or installed), refusal, aged, timed)


def _refused(experiment: Experiment, cell: Cell) -> tuple[str, str] | None:
    reason = study_of(experiment).unsupported_reason(cell)
    return None if reason is None else ("unsupported", reason)


def expected_seconds(runs: Sequence[Planned], rows: pd.DataFrame) -> float:
    """Estimate the seconds the cells take, from stored times of like cells scaled to their samples; NaN without any."""
    if not runs:
        return 0.0
    history = rows[(rows["status"] == "ok") & (rows["wall_s"] > 0)]
    if history.empty:
        return math.nan
    rate = history["wall_s"] / (history["samples"] * history["repeats"])
    like = rate.groupby([history["backend"].str.partition("[")[0], history["estimator"]]).median().to_dict()
    typical = float(rate.median())
    names = [(item.cell, item.cell.parts.get("estimator")) for item in runs]
    return sum(like.get((c.backend.name, e.name if e else ""), typical) * c.samples * c.repeats for c, e in names)


def versions(backend: Backend) -> str:
    """Return the versions of the libraries that a backend's numbers depend on."""
    return _versions(type(backend))


@remember
def _versions(backend: type[Plugin]) -> str:
    names = dict.fromkeys(["numpy", *(r.partition("=")[2] or r.partition("=")[0] for r in backend.requires)])
    return ";".join(f"{name}={_version(name)}" for name in names)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "?"
