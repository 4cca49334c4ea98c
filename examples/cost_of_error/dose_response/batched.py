"""Runs searches that differ only in their seed together, in shared batches of rollouts."""

from __future__ import annotations

import dataclasses
import itertools
import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import Any

import numpy as np

from bench.errors import StorageError
from bench.model import Problem

Outcome = dict[str, Any] | BaseException
"""The columns that a search returns, or the exception that it raises."""


@dataclasses.dataclass
class Request:
    """A function call that a search waits for, or the outcome of a search that has ended."""

    function: str = ""
    theta: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((0, 0)))
    w: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((0, 0)))
    outcome: Outcome | None = None


class Lane(Problem):
    """A problem shared by several searches: each call waits until every search has made one, then all run as one batch.

    Each search has its own thread and its own lane. Only one thread runs at a time, always in the same order, so that
    results do not depend on scheduling. Trajectories and step Jacobians are computed per lane, not in batches.
    """

    def __init__(self, inner: Problem, search: Callable[[Problem], dict[str, Any]]) -> None:
        super().__init__(inner.program)
        self._inner, self._search = inner, search
        self.device, self.provides = inner.device, inner.provides
        self._requests: SimpleQueue[Request] = SimpleQueue()
        self._answers: SimpleQueue[np.ndarray | BaseException] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> Request:
        """Start the search and return its first request."""
        self._thread.start()
        return self._requests.get()

    def resume(self, answer: np.ndarray | BaseException) -> Request:
        """Answer the search's request; return its next request, or its outcome at its end."""
        self._answers.put(answer)
        return self._requests.get()

    def _run(self) -> None:
        try:
            outcome: Outcome = self._search(self)
        except BaseException as error:  # reported in this seed's row
            outcome = error
        self._requests.put(Request(outcome=outcome))

    def _call(self, function: str, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        theta = np.asarray(theta, dtype=np.float64).reshape(self.dim, -1)
        self._requests.put(Request(function, np.broadcast_to(theta, (self.dim, w.shape[1])), w))
        answer = self._answers.get()
        if isinstance(answer, BaseException):
            raise answer
        return answer

    _value = _grad = _score = None  # type: ignore[assignment]

    @property
    def gives_jacobians(self) -> bool:
        """Whether the shared problem defines :meth:`jacobians`."""
        return self._inner.gives_jacobians

    def jacobians(self, theta: np.ndarray, w: np.ndarray) -> Any:
        """Return the step Jacobians."""
        return self._inner.jacobians(theta, w)

    def trajectory(self, theta: np.ndarray, w: np.ndarray) -> Any:
        """Return the states."""
        return self._inner.trajectory(theta, w)

    def value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return costs ``(B,)``."""
        self.usage.rollouts += w.shape[1]
        return self._call("value", theta, w)

    def grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return per-sample gradients ``(d, B)``."""
        self.usage.gradients += w.shape[1]
        return self._call("grad", theta, w)

    def score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return per-sample scores ``(d, B)``."""
        return self._call("score", theta, w)


def run_batched(problem: Problem, searches: Sequence[Callable[[Problem], dict[str, Any]]]) -> list[Outcome]:
    """Run searches in lockstep and return their outcomes in order.

    Each round calls the problem once per requested function. Searches with the same optimizer need one round per call.
    """
    lanes = [Lane(problem, search) for search in searches]
    requests = {lane: lane.start() for lane in lanes}
    while waiting := [lane for lane in lanes if requests[lane].outcome is None]:
        for function in list(dict.fromkeys(requests[lane].function for lane in waiting)):
            group = [lane for lane in waiting if requests[lane].function == function]
            for lane, answer in zip(group, _evaluate(problem, [requests[lane] for lane in group]), strict=True):
                requests[lane] = lane.resume(answer)
            # a resumed search may request the same function again: that request waits for the next round
            waiting = [lane for lane in waiting if lane not in group]
    return [requests[lane].outcome or {} for lane in lanes]


def _evaluate(problem: Problem, requests: list[Request]) -> list[np.ndarray | BaseException]:
    """Return the answers to requests of one function, from one shared call, or from one call per request if that fails."""
    function = getattr(problem, requests[0].function)
    widths = [request.w.shape[1] for request in requests]
    try:
        with np.errstate(all="ignore"):
            values = function(*(np.concatenate([getattr(r, n) for r in requests], axis=1) for n in ("theta", "w")))
    except (StorageError, KeyboardInterrupt):
        raise
    except BaseException as error:
        if len(requests) == 1:
            return [error]
        return list(itertools.chain.from_iterable(_evaluate(problem, [request]) for request in requests))
    return [np.ascontiguousarray(part) for part in np.split(values, np.cumsum(widths)[:-1], axis=-1)]
