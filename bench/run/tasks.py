"""Tasks (cells to measure, references to compute): handles them, groups them, and turns their results into rows."""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Literal

from bench.errors import STATUSES, StorageError, failure, printable
from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.keys import fingerprint, names_files
from bench.experiment.parameters import PROBLEM
from bench.experiment.study import Study
from bench.host import guard, isolation, reads
from bench.measure import descent, noise
from bench.measure.statistics import PHYSICS
from bench.model import Backend, Plugin, registry
from bench.run.plan import versions
from bench.run.pool import TaskResult
from bench.run.record import kind_of_machine
from bench.run.rows import rule
from bench.run.session import RunSession

MAX_REASON = 2000
"""Length of the longest stored reason, in characters."""
FAILED = ("error", "crashed", "timeout")
"""Statuses of cells that failed."""

RAN: set[str] = set()
"""The modules and files from outside whose code this process has run."""


@dataclass(frozen=True)
class Task:
    """A cell to measure, a cell whose reference gradient is to be computed, or the start of a descent to be computed."""

    cell: Cell
    kind: Literal["", "reference", "descent"] = ""

    def __str__(self) -> str:
        shown = {**self.cell.parts, "integrator": None, "backend": self.backend}
        parts = [part for axis, part in shown.items() if not (self.kind == "reference" and axis == "estimator")]
        return " ".join([*[f"{self.kind} of"] * bool(self.kind), *(p.name for p in parts if p is not None)])

    @property
    def backend(self) -> Backend:
        """The backend that runs the task."""
        return self.cell.reference_backends[0] if self.kind == "reference" else self.cell.backend

    @cached_property
    def outside(self) -> frozenset[str]:
        """The modules and files from outside this package whose code the task runs; known wherever the task is sent."""
        cell = self.cell
        return outside_of([*cell.parts.values(), cell.study, self.backend, *cell.ranked_backends])

    @property
    def outside_of_reference(self) -> frozenset[str]:
        """The part of :attr:`outside` that decides the reference gradient."""
        program = (self.cell.parts.get(axis) for axis in PROBLEM)
        if self.kind == "reference":
            return self.outside
        return outside_of([*program, *self.cell.reference_backends])


class TaskHandler:
    """Handles the tasks of one experiment, in a worker or in this process."""

    def __init__(self, experiment: Experiment, single_thread: bool = False) -> None:
        self._session = RunSession(experiment)
        self._study = experiment.study
        self._state = isolation.ProcessState(single_thread)
        RAN.update(registry.IMPORTED)
        self.is_tainted = False
        """Whether later items need a new process."""

    def close(self) -> None:
        """Restore the numbers of threads."""
        self._state.close()

    def prepare(self, item: Task) -> None:
        """Load the item's plugins and compile the program, so that the backend imports its libraries."""
        if registry.is_restricted():
            registry.restrict(item.outside)
        with guard.protect_process():
            try:
                self._session.problems.of(item.backend, item.cell)
            except KeyboardInterrupt:
                raise
            except BaseException:  # the error is reported when the cell is measured
                pass
        self._state.follow()

    def __call__(self, item: Task) -> dict[str, Any]:
        """Return the results of the cell, or the status and reason of its failure, and what code from outside has read.

        The reason names code from outside that the process has run for other cells.
        """
        RAN.update(item.outside)
        for name in item.outside:
            if os.path.isabs(name) and not name.startswith(reads.INSIDE):  # those of this package are in the key
                reads.note(name)
        result = self._handle(item)
        is_reduced = isolation.reduced_precision()
        uses_jax = any(requirement.partition("=")[0] == "jax" for requirement in item.backend.requires)
        if is_reduced and uses_jax and result.get("dtype", item.cell.backend.dtype) == "float64":
            result["dtype"] = "float32"
        self.is_tainted = is_reduced or self._study.fresh_process or not registry.is_restricted()
        if RAN:
            result["reads"] = reads.manifest()
        if others := RAN - item.outside:
            remark = f"this process has also run code of {printable(', '.join(sorted(others)))}"
            result = with_remarks(result, remark)
        return result

    def _handle(self, item: Task) -> dict[str, Any]:
        # other code may have changed what computes it
        self._session.references.stores = item.outside_of_reference >= RAN
        with guard.protect_process():
            if not item.kind:
                return measure_cell(item.cell, self._session, self._study)
            try:
                if item.kind == "descent":
                    return {"status": "ok", "descent": asdict(descent.descend(self._session.problem(item.cell)))}
                self._session.references.of(item.cell)
            except (StorageError, KeyboardInterrupt):
                raise
            except BaseException as error:
                return dict(failure(error))
            return {"status": "ok"}


def outside_of(parts: Iterable[Plugin | None]) -> frozenset[str]:
    """Return the modules and files from outside this package that decide what plugins do."""
    known = [part for part in parts if part is not None]
    foreign = [part for part in known if not type(part).__module__.startswith("bench.") or names_files(part)]
    names = {type(part).__module__ for part in foreign}
    for part in foreign:
        with suppress(Exception):  # the error is reported when the cell is measured
            names |= set(map(str, part.files() if names_files(part) else ()))  # type: ignore[attr-defined]
    return frozenset(names)


def measure_cell(cell: Cell, session: RunSession, study: Study) -> dict[str, Any]:
    """Return the results of a cell, or the status and reason of its failure; never raises for a plugin's error."""
    try:
        result = study.measure(cell, session)
        if not isinstance(result, dict) or not isinstance(result.get("status"), str):
            raise TypeError(f"measure() of study {study.name} must return a dictionary with a status")
        if fault := _fault_of(result, study):
            raise TypeError(f"measure() of study {study.name} returned {fault}")
    except (StorageError, KeyboardInterrupt):
        raise
    except BaseException as error:  # a plugin that exits must not end a run in this process
        return dict(failure(error))
    if not cell.timing:
        blank = study.columns.blank()
        result |= {name: blank[name] for name in study.columns.measured}
    result = solved(cell, session, result)
    return with_remarks(result, *cell.remarks)


def with_remarks(result: dict[str, Any], *remarks: str) -> dict[str, Any]:
    """Return a result with remarks at the end of its reason."""
    return result | {"reason": "; ".join(filter(None, (result.get("reason", ""), *remarks)))}


def solved(cell: Cell, session: RunSession, result: dict[str, Any]) -> dict[str, Any]:
    """Return a result with the residual of the backend's constraint solver, and its remarks, also where it has not converged.

    A backend whose physics differ from those that its name stands for has a method ``remarks(program)``: a text for each.
    A backend whose steps solve for contact forces iteratively has a method ``solver_residual(problem, w)``: the largest
    residual along rollouts from theta0 with noise ``w (n_w, B)``, relative to the forces of a step.
    """
    backend: Any = cell.parts.get("backend")
    names = [name for name in ("remarks", "solver_residual") if hasattr(backend, name)]
    if not names or result["status"] != "ok":
        return result
    program = cell.program()
    remarks = [f"{PHYSICS}{text}" for text in backend.remarks(program)] if "remarks" in names else []
    if "solver_residual" in names:
        w = noise.shared(cell.seed, cell.scene.name, 1, cell.samples, program.n_noise)[0].T
        residual = float(backend.solver_residual(session.problem(cell), w))
        result |= {"solver_residual": residual}
        # largest relative residual of a constraint solver that has converged, by type of the simulation
        if residual > {"float64": 1e-8, "float32": 1e-4}[cell.backend.dtype]:
            remarks.append(
                f"the constraint solver has not converged (relative residual {residual:.1e}): more iterations give another gradient"
            )
    return with_remarks(result, *remarks)


def _fault_of(result: dict[str, Any], study: Study) -> str:
    """Return the first value of a result that its column cannot hold, in words; empty if there is none."""
    if result["status"] not in STATUSES:
        return f"the status {printable(result['status'])[:100]!r}, which is not one of {', '.join(STATUSES)}"
    for name, value in result.items():
        column = study.columns.by_name.get(name)
        if column is None:
            return f"{name!r}, which is not one of its columns"
        holds, words = rule(name, study.columns)
        if not holds(value):
            return f"{name}={printable(repr(value))[:100]}, which {words}"
    try:
        json.dumps(result)
    except (TypeError, ValueError) as error:
        return f"values that cannot be stored: {printable(error)}"
    return ""


def group_by_program(tasks: list[Task]) -> list[list[Task]]:
    """Return groups of tasks that share a compilation and run the same code from outside; those that run none come first."""
    groups: dict[Any, list[Task]] = defaultdict(list)
    for task in tasks:
        groups[fingerprint(task.backend), repr(task.cell.program().structure), task.outside].append(task)
    return sorted(groups.values(), key=lambda group: sorted(group[0].outside))


def result_of(answer: TaskResult, prefix: str = "") -> dict[str, Any]:
    """Return an answer's result with its time and machine; a failure's reason gets the prefix and the last output."""
    result = answer.result | {"wall_s": answer.seconds, "machine": kind_of_machine()}
    if result["status"] in FAILED:
        output = f"; last output: {answer.output}" if answer.output else ""
        result["reason"] = f"{prefix}{result['reason']}{output}"
    return result


def row_of(experiment: Experiment, cell: Cell, result: dict[str, Any]) -> dict[str, Any]:
    """Return the row of a result, with the reason cut to one line of at most 2000 characters."""
    row = blank_row(experiment, cell) | result
    reason = printable(row["reason"])
    if len(reason) > MAX_REASON:
        reason = f"{reason[:MAX_REASON]}... ({len(reason)} characters)"
    return row | {"reason": reason}


def blank_row(experiment: Experiment, cell: Cell) -> dict[str, Any]:
    """Return a cell's row with its identity filled in and every result missing."""
    identity = {**cell.columns(), "experiment": experiment.name, "versions": versions(cell.backend)}
    return experiment.columns.blank() | identity
