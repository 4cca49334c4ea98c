"""Plan, then cells to rows: each row is stored before the next cell starts."""

from __future__ import annotations

import traceback
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Protocol

from bench import studies
from bench.contracts import Backend, Unsupported
from bench.grid import Cell, Experiment, cells
from bench.session import Session
from bench.store import Store
from bench.studies import Study


@dataclass(frozen=True)
class Planned:
    """A cell, and whether it is stored already, refused or to be run."""

    cell: Cell
    stored: bool
    refusal: tuple[str, str] | None

    @property
    def runs(self) -> bool:
        """Whether the cell has to be simulated."""
        return not self.stored and self.refusal is None


def plan(experiment: Experiment, store: Store) -> list[Planned]:
    """Every cell of the experiment in order; raises :class:`UserError` for a bad one."""
    stored = set(store.load()["key"])
    return [Planned(cell, cell.key in stored, cell.refusal()) for cell in cells(experiment)]


class Watcher(Protocol):
    """What is told of a run's progress."""

    def __call__(self, cell: Cell, row: dict[str, Any]) -> None:
        """One cell is finished and stored."""


def run(experiment: Experiment, planned: list[Planned], store: Store, watch: Watcher) -> None:
    """Run the missing cells and store their rows."""
    store.prepare()
    session = Session(experiment)
    study = studies.find(experiment.study)
    for item in planned:
        if item.stored:
            continue
        row = blank(experiment, item.cell, study)
        if item.refusal is not None:
            row["status"], row["reason"] = item.refusal
        else:
            row |= outcome(item.cell, session, study)
        store.append(row)
        watch(item.cell, row)


def blank(experiment: Experiment, cell: Cell, study: Study) -> dict[str, Any]:
    """A row with its identity filled in and every result missing."""
    row: dict[str, Any] = study.COLUMNS.blank()
    row |= cell.columns()
    row["experiment"] = experiment.name
    row["versions"] = versions(cell.backend)
    return row


def outcome(cell: Cell, session: Session, study: Study) -> dict[str, Any]:
    """The results of a cell, or the status and reason of its failure; never raises for what a plugin does."""
    try:
        return study.measure(cell, session)
    except Unsupported as error:
        return {"status": "unsupported", "reason": str(error)}
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{where.filename.rpartition('/')[2]}:{where.lineno}"
        return {"status": "error", "reason": f"{type(error).__name__}: {error} ({place})"}


def versions(backend: Backend) -> str:
    """Versions of the libraries that a backend's numbers rest on."""
    names = dict.fromkeys(["numpy", *(r.partition("=")[2] or r.partition("=")[0] for r in backend.requires)])
    return ";".join(f"{name}={_version(name)}" for name in names)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "?"
