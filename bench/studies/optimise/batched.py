"""Searches that differ by seed only, side by side: one batch of rollouts where each alone would make its own."""

from __future__ import annotations

import dataclasses
import itertools
import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from bench.errors import StorageError, Unsupported
from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.grid import cells
from bench.experiment.session import Session
from bench.model import Problem
from bench.studies.optimise.measure import OptimizerRun, known_optimum, measure, qualities, scene_class

Settings = Any
"""The study, whose parameters say how to search."""
Outcome = dict[str, Any] | BaseException


@dataclasses.dataclass
class Request:
    """A call that a search waits for, or how the search ended."""

    function: str = ""
    theta: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((0, 0)))
    w: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((0, 0)))
    ended: Outcome | None = None


class Lane(Problem):
    """A problem for one of several searches: its calls wait until all searches have one, and are made together.

    A search runs in a thread of its own, but one at a time and in order, so that nothing depends on who is faster.
    Trajectories and step Jacobians are computed lane by lane.
    """

    def __init__(self, inner: Problem, search: Callable[[Problem], dict[str, Any]]) -> None:
        super().__init__(inner.program)
        self._inner, self._search = inner, search
        self.device, self.provides = inner.device, inner.provides
        self._asked: SimpleQueue[Request] = SimpleQueue()
        self._answers: SimpleQueue[np.ndarray | BaseException] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> Request:
        """Run the search to its first call."""
        self._thread.start()
        return self._asked.get()

    def go_on(self, answer: np.ndarray | BaseException) -> Request:
        """Run the search from the answer to its next call or its end."""
        self._answers.put(answer)
        return self._asked.get()

    def _run(self) -> None:
        try:
            ended: Outcome = self._search(self)
        except BaseException as error:  # belongs to this seed's row
            ended = error
        self._asked.put(Request(ended=ended))

    def _ask(self, function: str, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        theta = np.asarray(theta, dtype=np.float64).reshape(self.dim, -1)
        self._asked.put(Request(function, np.broadcast_to(theta, (self.dim, w.shape[1])), w))
        answer = self._answers.get()
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return costs, ``(B,)``."""
        self.usage.rollouts += w.shape[1]
        return self._ask("value", theta, w)

    def grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return per-sample gradients, ``(d, B)``."""
        self.usage.gradients += w.shape[1]
        return self._ask("grad", theta, w)

    def score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return per-sample scores, ``(d, B)``."""
        return self._ask("score", theta, w)

    def explicit(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return per-sample derivatives by theta along every path but the actions, ``(d, B)``."""
        if self.program.explicit:
            self.usage.gradients += w.shape[1]
        return self._ask("explicit", theta, w)

    def jacobians(self, theta: np.ndarray, w: np.ndarray) -> Any:
        """Return the step Jacobians."""
        return self._inner.jacobians(theta, w)

    def trajectory(self, theta: np.ndarray, w: np.ndarray) -> Any:
        """Return the states."""
        return self._inner.trajectory(theta, w)

    _value = _grad = _score = None  # type: ignore[assignment]


def side_by_side(problem: Problem, searches: Sequence[Callable[[Problem], dict[str, Any]]]) -> list[Outcome]:
    """Return what each search returns or raises; their calls to the problem are made together, round by round.

    A round is one call of the problem per function asked for: of searches with the same optimizer, one per step of theirs.
    """
    lanes = [Lane(problem, search) for search in searches]
    asked = {lane: lane.start() for lane in lanes}
    while waiting := [lane for lane in lanes if asked[lane].ended is None]:
        for function in list(dict.fromkeys(asked[lane].function for lane in waiting)):
            group = [lane for lane in waiting if asked[lane].function == function]
            for lane, answer in zip(group, _together(problem, [asked[lane] for lane in group]), strict=True):
                asked[lane] = lane.go_on(answer)
            # those that went on may ask for the same again: they wait for the next round
            waiting = [lane for lane in waiting if lane not in group]
    return [asked[lane].ended or {} for lane in lanes]


def _together(problem: Problem, requests: list[Request]) -> list[np.ndarray | BaseException]:
    """Return the answers to calls of one function; where the joint call fails, each alone, so that one spoils no other."""
    function = getattr(problem, requests[0].function)
    widths = [request.w.shape[1] for request in requests]
    try:
        with np.errstate(all="ignore"):
            found = function(*(np.concatenate([getattr(r, n) for r in requests], axis=1) for n in ("theta", "w")))
    except (StorageError, KeyboardInterrupt):
        raise
    except BaseException as error:
        if len(requests) == 1:
            return [error]
        return list(itertools.chain.from_iterable(_together(problem, [request]) for request in requests))
    return [np.ascontiguousarray(part) for part in np.split(found, np.cumsum(widths)[:-1], axis=-1)]


# ------------------------------------------------------------------------------------------------- cells of a study


@dataclasses.dataclass(frozen=True)
class LaneSession:
    """What :func:`measure` needs of a session: the experiment, and the lane as the problem."""

    experiment: Experiment
    lane: Problem

    def problem(self, cell: Cell) -> Problem:
        """Return the lane."""
        return self.lane


_found: WeakKeyDictionary[Session, dict[str, Outcome]] = WeakKeyDictionary()
"""By session and key, searches that have ended and whose cell has not been asked for yet."""
_groups: WeakKeyDictionary[Session, dict[str, list[Cell]]] = WeakKeyDictionary()
"""By session and key without the seed, the cells that differ by it."""


def measure_batched(cell: Cell, session: Session, settings: Settings) -> dict[str, Any]:
    """Measure a cell together with those planned after it that differ by the seed only; these are then there when asked for."""
    found = _found.setdefault(session, {})
    if cell.key not in found:
        found |= _search(_seeds(cell, session), session, settings)
    outcome = found.pop(cell.key)
    if isinstance(outcome, BaseException):
        raise outcome
    return outcome


def _seeds(cell: Cell, session: Session) -> list[Cell]:
    """Return the cell and those after it that differ by the seed only."""
    if session not in _groups:
        groups: dict[str, list[Cell]] = {}
        for other in cells(session.experiment):
            groups.setdefault(_without_seed(other), []).append(other)
        _groups[session] = groups
    group = _groups[session].get(_without_seed(cell), [])
    place = next((i for i, other in enumerate(group) if other.key == cell.key), None)
    return [cell] if place is None else list({other.key: other for other in group[place:]}.values())


def _without_seed(cell: Cell) -> str:
    return dataclasses.replace(cell, seed=0).key


def _search(group: list[Cell], session: Session, settings: Settings) -> dict[str, Outcome]:
    problem = session.problem(group[0])
    _prepare(group[0], problem, session, settings)

    def search(cell: Cell) -> Callable[[Problem], dict[str, Any]]:
        return lambda lane: measure(cell, LaneSession(session.experiment, lane), settings)  # type: ignore[arg-type]

    outcomes = side_by_side(problem, [search(cell) for cell in group])
    return {cell.key: outcome for cell, outcome in zip(group, outcomes, strict=True)}


def _prepare(cell: Cell, problem: Problem, session: Session, settings: Settings) -> None:
    """Compute once what does not depend on the seed, and is remembered; what fails here fails in each search again."""
    try:
        known_optimum(cell, problem, session, settings)
        scene_class(cell, problem)
        if settings.quality != "none":
            theta0 = np.array(problem.program.theta0, dtype=np.float64)
            qualities(OptimizerRun(cell, problem, settings), theta0, settings, ("start",))
    except (Unsupported, ArithmeticError, ValueError, TypeError):
        return
