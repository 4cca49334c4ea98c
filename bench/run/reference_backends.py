"""Chooses the backends that can compute a cell's reference gradient, and those that can run a program at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

from bench.errors import Unsupported
from bench.experiment.cell import Cell
from bench.experiment.keys import fingerprint, hashed
from bench.model import Backend, Estimator, Problem, Program, Smoothing, registry
from bench.model.parameters import build

_ranked: dict[str, list[Backend]] = {}
_built: dict[type[Backend], Backend] = {}


def reference_backends(cell: Cell) -> Iterator[Backend]:
    """Yield the backends able to run the cell's program for a reference, best first, the cell's own last.

    A backend with physics of its own runs its own program, so only it can compute that program's reference.
    """
    if "physics" not in cell.backend.provides:
        yield from ranked_backends(cell)
    yield cell.backend


def reference_key(cell: Cell) -> str:
    """Return the hash of all that decides the reference gradient; raises ValueError if the study computes none."""
    if cell.budget is None:
        raise ValueError(
            f"study {cell.study.name} computes no reference: add a column `reference_method` to its columns to get one"
        )
    budget = [cell.budget.samples, cell.budget.tolerance]
    asked = smoothing_of(cell)
    other = [] if asked is None else [[asked.shape, asked.radius]]
    return hashed(cell.program_key, budget, fingerprint(next(reference_backends(cell))), *other)


def smoothing_of(cell: Cell) -> Smoothing | None:
    """Return the smoothing that the cell's estimator is measured against; None for J_sigma."""
    estimator = cell.parts.get("estimator")
    return estimator.smoothing(cell.program()) if isinstance(estimator, Estimator) else None


def ranked_backends(cell: Cell) -> list[Backend]:
    """Return the available backends that compute references and can run the scene's own program, best first."""
    if cell.program_key not in _ranked:
        candidates = []
        with suppress(Unsupported):
            candidates = able_backends(cell.program(), ranked=True)
        _ranked[cell.program_key] = sorted(candidates, key=lambda b: b.reference_rank or 0)
    return _ranked[cell.program_key]


def able_backends(program: Program, ranked: bool = False) -> list[Backend]:
    """Return the available backends, with default parameters, that can run a program; or those that give references."""
    backends = []
    for entry in registry.entries()["backends"].values():
        if entry.plugin is None or not entry.available or not issubclass(entry.plugin, Backend):
            continue
        if ranked and entry.plugin.reference_rank is None:  # not asked, since a backend may have to trace the program
            continue
        with suppress(Exception):  # a backend that fails at this question cannot run the program
            backend = _default(entry.plugin)
            if backend.incompatibility(program) is None:
                backends.append(backend)
    return backends


def _default(plugin: type[Backend]) -> Backend:
    if plugin not in _built:
        backend = build(plugin, {})
        assert isinstance(backend, Backend)
        _built[plugin] = backend
    return _built[plugin]


def linearising(program: Program) -> list[str]:
    """Return the names of the available backends whose problems give step Jacobians for a program."""
    return [b.name for b in able_backends(program) if type(b.compile(program)).jacobians is not Problem.jacobians]
