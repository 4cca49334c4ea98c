"""Runs the scenes of an experiment as the rungs of a ladder: a rung starts when the checks of the rung below pass.

Each backend climbs independently of the others. The cells above a rung that did not pass become rows with the status
``waiting`` and the reason; they run as soon as that rung passes.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from bench.errors import printable
from bench.experiment.experiment import Experiment
from bench.experiment.study import Study
from bench.run.plan import Planned
from bench.run.store import Store

if TYPE_CHECKING:
    import pandas as pd

WAITING = "waiting"
"""Status of a cell that waits for a rung below it."""


def climb(
    experiment: Experiment,
    planned: Sequence[Planned],
    store: Store,
    run: Callable[[Sequence[Planned]], None],
    quiet: bool = False,
) -> None:
    """Call ``run`` with the cells of one rung after the other, and print whether each passes unless ``quiet``."""
    stops: dict[str, str] = {}
    rungs: dict[str, list[Planned]] = {}
    for item in planned:
        rungs.setdefault(item.cell.columns()["scene"], []).append(item)
    for name, items in rungs.items():
        run([_held_back(item, stops.get(item.cell.columns()["backend"])) for item in items])
        rows = store.load()
        rows = rows[rows["key"].isin([item.cell.key for item in items])]
        for backend, part in rows.groupby("backend", sort=False):
            if backend in stops:
                continue
            fault = fault_of(experiment.study, part)
            if fault:
                stops[str(backend)] = f"the rung below ({name}) did not pass: {fault}"
            verdict = f"did not pass: {fault}" if fault else "passed"
            if not quiet:
                print(f"{experiment.name}: rung {name} {verdict} ({backend})", file=sys.stderr)


def _held_back(item: Planned, reason: str | None) -> Planned:
    """Return a cell that has no result yet with the reason why it cannot start, if there is one."""
    if reason is None or item.stored or item.refusal is not None:
        return item
    return replace(item, refusal=(WAITING, reason))


def fault_of(study: Study, rows: pd.DataFrame) -> str:
    """Return why the rows of a rung do not pass, in words; empty if they pass.

    They pass if at least one cell was checked, no cell failed, and the study finds no :meth:`~Study.failure`.
    """
    checked = rows[~rows["status"].isin(("unsupported", "unavailable", WAITING))]
    if checked.empty:
        return f"no cell could be checked ({', '.join(dict.fromkeys(map(printable, rows['reason'])))})"
    failed = checked[checked["status"] != "ok"]
    if len(failed):
        counts = ", ".join(f"{count} {status}" for status, count in Counter(failed["status"]).items())
        return f"{counts} of {len(checked)} cells ({printable(failed['reason'].iloc[0])[:200]})"
    return study.failure(checked)
