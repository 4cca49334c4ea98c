"""Chooses the backends that can compute a cell's reference gradient, and those that can run a program."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import cast

from bench.errors import Unsupported
from bench.experiment.cell import Cell
from bench.experiment.keys import fingerprint, hashed
from bench.model import Backend, Estimator, Problem, Program, Smoothing, registry
from bench.model.parameters import build, remember

_ranked: dict[str, list[Backend]] = {}


def reference_backends(cell: Cell) -> Iterator[Backend]:
    """Yield the backends able to run the cell's program for a reference, best first, the cell's own last.

    A backend with physics of its own runs its own program, so only it can compute that program's reference.
    """
    if "physics" not in cell.backend.provides:
        yield from ranked_backends(cell)
    yield cell.backend


def reference_key(cell: Cell) -> str:
    """Return the hash of everything that decides the reference gradient; raises ValueError if the study needs none."""
    if cell.budget is None:
        raise ValueError(
            f"study {cell.study.name} has no references: add a column `reference_method` to its columns to get them"
        )
    budget = [cell.budget.samples, cell.budget.tolerance]
    smoothing = smoothing_of(cell)
    parts = [] if smoothing is None else [[smoothing.shape, smoothing.radius]]
    return hashed(cell.program_key, budget, fingerprint(next(reference_backends(cell))), *parts)


def smoothing_of(cell: Cell) -> Smoothing | None:
    """Return the smoothing of the objective whose gradient the cell's estimator estimates; None for J_sigma."""
    estimator = cell.parts.get("estimator")
    return estimator.smoothing(cell.program()) if isinstance(estimator, Estimator) else None


def ranked_backends(cell: Cell) -> list[Backend]:
    """Return the available backends that compute references and can run the scene's own program, best first."""
    if cell.program_key not in _ranked:
        candidates = []
        with suppress(Unsupported):
            candidates = capable_backends(cell.program(), for_references=True)
        _ranked[cell.program_key] = sorted(candidates, key=lambda b: b.reference_rank or 0)
    return _ranked[cell.program_key]


def capable_backends(program: Program, for_references: bool = False) -> list[Backend]:
    """Return the available backends, with default parameters, that can run a program, or compute its references."""
    backends = []
    for entry in registry.entries()["backends"].values():
        if entry.plugin is None or not entry.available or not issubclass(entry.plugin, Backend):
            continue
        if (
            for_references and entry.plugin.reference_rank is None
        ):  # checked first: incompatibility() may trace the program
            continue
        with suppress(Exception):  # a backend that fails here cannot run the program
            backend = _with_defaults(entry.plugin)
            if backend.incompatibility(program) is None:
                backends.append(backend)
    return backends


@remember
def _with_defaults(plugin: type[Backend]) -> Backend:
    return cast(Backend, build(plugin, {}))


def backends_with_jacobians(program: Program) -> list[str]:
    """Return the names of the available backends that compute the step Jacobians of a program."""
    return [b.name for b in capable_backends(program) if type(b.compile(program)).jacobians is not Problem.jacobians]
