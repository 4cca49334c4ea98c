"""Plans a run: which cells are stored, which are refused, and which have to be run."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.errors import UserError
from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.grid import COUNTS, cells
from bench.experiment.parameters import completed_json
from bench.host import guard, reads
from bench.host.parameters import remember
from bench.model import Backend, Plugin, registry
from bench.run.record import version_of
from bench.run.store import Store

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Planned:
    """A cell, and whether it is stored already, refused or due to run."""

    cell: Cell
    stored: bool
    refusal: tuple[str, str] | None
    """Status and reason if the cell cannot run."""
    other_versions: str = ""
    """Library versions of the stored row, if they differ from the installed ones."""
    machine: str = ""
    """The kind of machine that timed the stored row."""
    stale: str = ""
    """What the stored row has read that has changed since."""

    @property
    def runs(self) -> bool:
        """Whether the cell has to be simulated."""
        return not self.stored and self.refusal is None


def plan(experiment: Experiment, store: Store) -> list[Planned]:
    """Return the experiment's cells, or those of its shard, in sweep order, each with its state.

    Raises :class:`UserError` for invalid values.
    """
    rows = store.load()
    facts = zip(*(rows[name] for name in ("status", "versions", "machine", "reads")), strict=True)
    stored = dict(zip(rows["key"], facts, strict=True))
    with guard.contained():
        mine = [cell for cell in cells(experiment) if _is_in_shard(cell, experiment.execution.shard)]
        present = reads.Present(registry.environment())
        return [_planned(experiment, cell, stored, present) for cell in mine]


def _is_in_shard(cell: Cell, shard: tuple[int, int] | None) -> bool:
    """Return whether a cell is in the part (number, count) of a sweep: a part has all cells of a reference."""
    if shard is None:
        return True
    number, count = shard
    key = cell.program_key if cell.budget is None else cell.reference_key
    return int(key, 16) % count == number - 1


def _planned(experiment: Experiment, cell: Cell, stored: dict[str, tuple[str, ...]], present: reads.Present) -> Planned:
    refusal = cell.refusal()
    if refusal is None and (reason := experiment.study.refusal(cell)) is not None:
        refusal = ("unsupported", reason)
    if cell.key not in stored:
        return Planned(cell, False, refusal)
    status, row_versions, machine, read = stored[cell.key]
    stale = present.change(read, row_versions)
    rules = experiment.execution
    is_current = rules.versions == "ignore" or status != "ok" or row_versions == versions(cell.backend)
    # a rung of a ladder waits for the rung below it
    again = bool(stale) or status in (*rules.retry, "waiting") or (not is_current and rules.versions == "rerun")
    # a plugin that was missing when the row was stored is installed now
    is_installed = status == "unavailable" and refusal is None
    timed = machine if cell.timing and status == "ok" and not again else ""
    return Planned(cell, not (again or is_installed), refusal, "" if is_current else row_versions, timed, stale)


def requested_rows(experiment: Experiment, rows: pd.DataFrame) -> tuple[pd.DataFrame, str]:
    """Return the stored rows of the experiment's cells, also of older code, and a sentence on how they differ from all rows.

    If none of its cells is stored, all rows are returned. The sentence is empty if the rows are exactly the cells, or if
    there are none.
    """
    if rows.empty:
        return rows, ""
    try:
        with guard.contained():
            every = cells(experiment)
            keys = {cell.key for cell in every}
            is_requested = rows["key"].isin(keys).to_numpy(copy=True)
            others = rows.loc[~is_requested, ["parameters", *COUNTS]]
            identities = {
                (completed_json(json.dumps(cell.parameters)), *(getattr(cell, name) for name in COUNTS))
                for cell in every
                if len(others)
            }
    except UserError:
        return rows, ""  # a plugin of the rows may not be installed any more
    facts = zip(others["parameters"].map(completed_json), *(others[name] for name in COUNTS), strict=True)
    is_requested[~is_requested] = [identity in identities for identity in facts]
    n_requested, n_others = int(is_requested.sum()), int((~is_requested).sum())
    if not n_requested:
        return (
            rows,
            f"none of the {len(every)} requested cells is stored; the {len(rows)} rows shown have other settings",
        )
    missing = (
        f"{len(every) - n_requested} of {len(every)} requested cells have no row" if n_requested < len(every) else ""
    )
    hidden = f"{n_others} stored rows of other settings are not shown" if n_others else ""
    shown = rows[is_requested].reset_index(drop=True) if n_others else rows
    return shown, "; ".join(part for part in (missing, hidden) if part)


def expected_seconds(runs: Sequence[Planned], rows: pd.DataFrame) -> float:
    """Estimate the seconds that the cells take, from the stored times of similar cells and the number of samples.

    Cells are similar if backend and estimator have the same names. Returns NaN where no times are stored.
    """
    if not runs:
        return 0.0
    history = rows[(rows["status"] == "ok") & (rows["wall_s"] > 0)]
    if history.empty:
        return math.nan
    rate = history["wall_s"] / (history["samples"] * history["repeats"])
    similar = rate.groupby([history["backend"].str.partition("[")[0], history["estimator"]]).median().to_dict()
    typical = rate.median()
    estimators = [item.cell.parts.get("estimator") for item in runs]
    names = [(item.cell.backend.name, e.name if e else "") for item, e in zip(runs, estimators, strict=True)]
    sizes = [item.cell.samples * item.cell.repeats for item in runs]
    return float(sum(similar.get(name, typical) * size for name, size in zip(names, sizes, strict=True)))


def versions(backend: Backend) -> str:
    """Return the versions of the libraries that a backend's numbers depend on, also in an engine's own Python."""
    own = [f"{backend.name}:{name}={value}" for name, value in backend.library_versions().items()]
    return ";".join([_versions(type(backend)), *own])


@remember
def _versions(backend: type[Plugin]) -> str:
    names = dict.fromkeys(["numpy", *(r.partition("=")[2] or r.partition("=")[0] for r in backend.requires)])
    return ";".join(f"{name}={version_of(name) or '?'}" for name in names)
