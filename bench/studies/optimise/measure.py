"""Measures one cell: by a separate search if it is timed, else together with the cells that differ only in their seed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from bench.errors import Unsupported
from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.grid import cells
from bench.experiment.session import Session
from bench.model import Problem
from bench.studies.optimise import Optimise
from bench.studies.optimise.batched import Outcome, run_batched
from bench.studies.optimise.search import (
    OptimizerRun,
    gradient_quality,
    known_optimum,
    run_search,
    scene_class,
)


@dataclasses.dataclass(frozen=True)
class LaneSession:
    """A session for :func:`~.search.run_search` whose problem is a lane."""

    experiment: Experiment
    lane: Problem

    def problem(self, cell: Cell) -> Problem:
        """Return the lane as the problem of any cell."""
        return self.lane


_outcomes: WeakKeyDictionary[Session, dict[str, Outcome]] = WeakKeyDictionary()
"""Outcomes of searches whose cells are measured later, by session and cell key."""
_groups: WeakKeyDictionary[Session, dict[str, list[Cell]]] = WeakKeyDictionary()
"""Cells that differ only in their seed, by session and by their key with seed 0."""


def measure(cell: Cell, session: Session, settings: Optimise) -> dict[str, Any]:
    """Return one cell's results by column. Untimed cells that differ only in their seed share batches of rollouts."""
    if cell.timing:
        return run_search(cell, session, settings)
    outcomes = _outcomes.setdefault(session, {})
    if cell.key not in outcomes:
        outcomes |= _run_group(_seed_group(cell, session), session, settings)
    outcome = outcomes.pop(cell.key)
    if isinstance(outcome, BaseException):
        raise outcome
    return outcome


def _seed_group(cell: Cell, session: Session) -> list[Cell]:
    """Return the cell and the later cells of the experiment that differ from it only in their seed.

    The processes of several workers do not know the other cells: there the cell is searched for separately.
    """
    if not session.experiment.choices:
        return [cell]
    if session not in _groups:
        groups: dict[str, list[Cell]] = {}
        for other in cells(session.experiment):
            groups.setdefault(_without_seed(other), []).append(other)
        _groups[session] = groups
    group = _groups[session].get(_without_seed(cell), [])
    index = next((i for i, other in enumerate(group) if other.key == cell.key), None)
    return [cell] if index is None else list({other.key: other for other in group[index:]}.values())


def _without_seed(cell: Cell) -> str:
    return dataclasses.replace(cell, seed=0).key


def _run_group(group: list[Cell], session: Session, settings: Optimise) -> dict[str, Outcome]:
    problem = session.problem(group[0])
    _fill_caches(group[0], problem, session, settings)

    def search(cell: Cell) -> Callable[[Problem], dict[str, Any]]:
        return lambda lane: run_search(cell, LaneSession(session.experiment, lane), settings)  # type: ignore[arg-type]

    outcomes = run_batched(problem, [search(cell) for cell in group])
    return {cell.key: outcome for cell, outcome in zip(group, outcomes, strict=True)}


def _fill_caches(cell: Cell, problem: Problem, session: Session, settings: Optimise) -> None:
    """Compute the cached values that do not depend on the seed. Ignore errors, because each search raises them again."""
    try:
        known_optimum(cell, problem, session)
        scene_class(cell, problem)
        if settings.quality != "none":
            theta0 = np.array(problem.program.theta0, dtype=np.float64)
            gradient_quality(OptimizerRun(cell, problem, settings), theta0, settings)
    except (Unsupported, ArithmeticError, ValueError, TypeError):
        return
