"""Tasks (cells to measure, references to compute): handles them, groups them, and turns their results into rows."""

from __future__ import annotations

import json
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from bench.errors import STATUSES, StorageError, failure, printable
from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.keys import fingerprint
from bench.experiment.study import Study, study_of
from bench.measure import noise
from bench.model import Backend, Plugin, Scene, guard, registry
from bench.model.isolation import State, reduced_precision
from bench.run.plan import versions
from bench.run.pool import Answer
from bench.run.record import kind_of_machine
from bench.run.session import Session

MAX_REASON = 2000
"""Length of the longest stored reason, in characters."""
FAILED = ("error", "crashed", "timeout")
"""Statuses of cells that failed."""
CONVERGED = {"float64": 1e-8, "float32": 1e-4}
"""Largest relative residual of a constraint solver that has converged, by type of the simulation."""


@dataclass(frozen=True)
class Task:
    """A cell to measure, or a cell whose reference gradient is to be computed."""

    cell: Cell
    reference: bool = False

    def __str__(self) -> str:
        shown = {**self.cell.parts, "integrator": None, "backend": self.backend}
        parts = [part for axis, part in shown.items() if not (self.reference and axis == "estimator")]
        return " ".join(["reference of" if self.reference else "", *(p.name for p in parts if p is not None)]).strip()

    @property
    def backend(self) -> Backend:
        """The backend that runs the task."""
        return self.cell.reference_backends[0] if self.reference else self.cell.backend

    @property
    def outside(self) -> frozenset[str]:
        """The modules and files from outside this package whose code the task runs."""
        parts = [*self.cell.parts.values(), self.cell.study, self.backend]
        foreign = [part for part in parts if part is not None and is_foreign(part)]
        names = {type(part).__module__ for part in foreign}
        for part in foreign:
            with suppress(Exception):  # the error is reported when the cell is measured
                names |= set(map(str, getattr(part, "files", tuple)()))
        return frozenset(names)


class TaskHandler:
    """Handles the tasks of one experiment, in a worker or in this process."""

    def __init__(self, experiment: Experiment, single_thread: bool = False) -> None:
        self._experiment = experiment
        self._session = Session(experiment)
        self._study = study_of(experiment)
        self._state = State(double_precision=True, single_thread=single_thread)
        self._ran_foreign_code = False
        self.is_tainted = False
        """Whether a plugin has changed the process, so that later items need a new one."""

    def close(self) -> None:
        """Stop following the state of the process."""
        self._state.close()

    def prepare(self, item: Task) -> None:
        """Compile the program, so that the backend imports its libraries."""
        if item.outside and not self._ran_foreign_code:
            registry.entries()  # imported before foreign code can change them, so that a change is seen
        with guard.protect_process():
            try:
                self._session.problems.of(item.backend, item.cell)
            except KeyboardInterrupt:
                raise
            except BaseException:  # the error is reported when the cell is measured
                return

    def __call__(self, item: Task) -> dict[str, Any]:
        """Return the results of the cell, or the status and reason of its failure.

        A change of the process that would change other cells' numbers is undone and added to the reason.
        """
        if item.outside and not self._ran_foreign_code:
            registry.entries()  # as in prepare, which only workers call
            self._state.adopt()
            self._ran_foreign_code = True
        result = self._handle(item)
        changes = self._state.changes(functions=self._ran_foreign_code)
        if not changes:
            return result
        if (
            result.get("dtype", item.cell.backend.dtype) == "float64"
            and reduced_precision()
            and _uses_jax(item.backend)
        ):
            result["dtype"] = "float32"
        self._state.restore()
        self._state.adopt()
        self._session = Session(self._experiment)
        self.is_tainted = True
        remark = f"a plugin of this cell changed {printable('; '.join(changes))}, which was undone before the next cell"
        return result | {"reason": "; ".join(part for part in (result.get("reason", ""), remark) if part)}

    def _handle(self, item: Task) -> dict[str, Any]:
        program = (item.cell.parts.get(axis) for axis in ("scene", "contact", "integrator", "backend"))
        is_built_in = not any(part is not None and is_foreign(part) for part in program)
        # foreign code may have changed what computes it
        self._session.references.stores = item.reference or not (item.outside and is_built_in)
        with guard.protect_process():
            if not item.reference:
                return measure_cell(item.cell, self._session, self._study)
            try:
                self._session.references.of(item.cell)
            except (StorageError, KeyboardInterrupt):
                raise
            except BaseException as error:
                return dict(failure(error))
            return {"status": "ok"}


def is_foreign(part: Plugin) -> bool:
    """Return whether a plugin's code is from outside this package."""
    return not type(part).__module__.startswith("bench.") or (isinstance(part, Scene) and hasattr(part, "files"))


def _uses_jax(backend: Backend) -> bool:
    return any(requirement.partition("=")[0] == "jax" for requirement in backend.requires)


def measure_cell(cell: Cell, session: Session, study: Study) -> dict[str, Any]:
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
    return result | solver_columns(cell, session, result)


def solver_columns(cell: Cell, session: Session, result: dict[str, Any]) -> dict[str, Any]:
    """Return the residual of the backend's constraint solver, with a remark in ``reason`` where it has not converged.

    A backend whose steps solve for contact forces iteratively has a method ``solver_residual(problem, w)``: the largest
    residual along rollouts from theta0 with noise ``w (n_w, B)``, relative to the forces of a step.
    """
    solver_residual = getattr(cell.parts.get("backend"), "solver_residual", None)
    if solver_residual is None or result["status"] != "ok":
        return {}
    program = cell.program()
    w = noise.shared(cell.seed, cell.scene.name, 1, cell.samples, program.n_noise)[0].T
    residual = float(solver_residual(session.problem(cell), w))
    if not residual > CONVERGED[cell.backend.dtype]:
        return {"solver_residual": residual}
    remark = f"the constraint solver has not converged (relative residual {residual:.1e}): more iterations give another gradient"
    return {"solver_residual": residual, "reason": "; ".join(filter(None, (result.get("reason", ""), remark)))}


def _fault_of(result: dict[str, Any], study: Study) -> str:
    """Return the first value of a result that its column cannot hold, in words; empty if there is none."""
    if result["status"] not in STATUSES:
        return f"the status {printable(result['status'])[:100]!r}, which is not one of {', '.join(STATUSES)}"
    types = {"number": (int, float, type(None)), "text": (str,), "list": (list, tuple)}
    for name, value in result.items():
        column = study.columns.by_name.get(name)
        if column is None:
            return f"{name!r}, which is not one of its columns"
        if not isinstance(value, types[column.kind]):
            return f"{name}={printable(repr(value))[:100]}, and that column holds a {column.kind}"
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


def result_of(answer: Answer, prefix: str = "") -> dict[str, Any]:
    """Return an answer's result with its time and machine; a failure's reason gets the prefix and the last output."""
    result = answer.result | {"wall_s": answer.seconds, "machine": answer.machine or kind_of_machine()}
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
