"""Runs searches that differ only in their seed together, in shared batches of rollouts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import Any

import numpy as np

from bench.model import Problem


class Lane(Problem):
    """A problem shared by several searches: each call waits until other searches have made theirs, and all run as one batch.

    Each search has its own thread and its own lane. Only one thread runs at a time, always in the same order, so that
    results do not depend on scheduling. Trajectories and step Jacobians are computed per lane, not in batches.
    """

    def __init__(self, inner: Problem, search: Callable[[Problem], Any]) -> None:
        super().__init__(inner.program)
        self._inner, self._search = inner, search
        self.device, self.provides = inner.device, inner.provides
        self.jacobians, self.trajectory = inner.jacobians, inner.trajectory  # type: ignore[method-assign]
        self._requests: SimpleQueue[Any] = SimpleQueue()
        self._answers: SimpleQueue[Any] = SimpleQueue()
        self.result: Any = None
        """What the search returns, or the exception that it raises."""
        threading.Thread(target=self._run, daemon=True).start()
        self.request = self._requests.get()
        """The name of the function that the search waits for, with theta and noise; None at its end."""

    def resume(self, answer: np.ndarray | BaseException) -> None:
        """Answer the search's request, and wait for the next one."""
        self._answers.put(answer)
        self.request = self._requests.get()

    def _run(self) -> None:
        try:
            self.result = self._search(self)
        except BaseException as error:  # raised by run_batched
            self.result = error
        self._requests.put(None)

    def _call(self, function: str, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        self._requests.put((function, np.broadcast_to(theta, (self.dim, w.shape[1])), w))
        answer = self._answers.get()
        if isinstance(answer, BaseException):
            raise answer
        return np.ascontiguousarray(answer)

    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return self._call("value", theta, w)

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return self._call("grad", theta, w)

    def _score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return self._call("score", theta, w)

    @property
    def gives_jacobians(self) -> bool:
        """Whether the shared problem defines :meth:`jacobians`."""
        return self._inner.gives_jacobians


def run_batched(problem: Problem, searches: Sequence[Callable[[Problem], Any]]) -> list[Any]:
    """Run searches in lockstep and return their results in order; raises the first error of a search.

    Each round calls the problem once, for all searches that wait for the same function as the first that waits.
    """
    lanes = [Lane(problem, search) for search in searches]
    while waiting := [lane for lane in lanes if lane.request]:
        function = waiting[0].request[0]
        group = [lane for lane in waiting if lane.request[0] == function]
        _, thetas, noises = zip(*(lane.request for lane in group), strict=True)
        answers: Sequence[Any] = ()
        try:
            with np.errstate(all="ignore"):
                values = getattr(problem, function)(np.concatenate(thetas, axis=1), np.concatenate(noises, axis=1))
            answers = np.split(values, np.cumsum([w.shape[1] for w in noises])[:-1], axis=-1)
        except BaseException as error:
            answers = [error] * len(group)
        for lane, answer in zip(group, answers, strict=True):
            lane.resume(answer)
    for lane in lanes:
        if isinstance(lane.result, BaseException):
            raise lane.result
    return [lane.result for lane in lanes]
