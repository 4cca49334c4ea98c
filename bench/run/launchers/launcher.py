"""The interface of launchers, which run tasks, and the launchers of this machine."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from types import TracebackType
from typing import Any, Protocol

from bench.experiment.experiment import Experiment
from bench.experiment.study import study_of
from bench.run.pool import BATCH_S, Answer, Pool, ResourceLimits
from bench.run.tasks import FAILED, Task, TaskHandler


class Launcher(Protocol):
    """Runs groups of tasks: a context manager that ends all its processes and jobs on exit."""

    def __enter__(self) -> Launcher: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> Any: ...

    def run(self, groups: Sequence[Sequence[Task]]) -> Iterator[list[Answer]]:
        """Yield answers as they arrive, one per task, and empty lists while the caller has to wait.

        The tasks of a group share a compilation, and run in one worker unless another worker is idle.
        """

    @property
    def current(self) -> list[Task]:
        """The tasks being worked on."""


class InProcessLauncher:
    """Runs tasks in this process, without limits on time and memory, for debugging."""

    def __init__(self, handle: TaskHandler) -> None:
        self._handle = handle
        self.current: list[Task] = []

    def __enter__(self) -> InProcessLauncher:
        return self

    def __exit__(self, *_: object) -> None:
        self._handle.close()

    def run(self, groups: Iterable[Iterable[Task]]) -> Iterator[list[Answer]]:
        """Yield an empty list before each task, and answers after it; the answers of quick tasks are yielded together."""
        answers: list[Answer] = []
        since = time.perf_counter()
        for task in itertools.chain.from_iterable(groups):
            self.current = [task]
            if task.outside:  # its code may change this process, so the answers before it are stored before
                yield answers
                answers = []
            else:
                yield []
            started = time.perf_counter()
            try:
                self._handle.prepare(task)
                started = time.perf_counter()
                answers.append(Answer(task, self._handle(task), time.perf_counter() - started))
            except BaseException:
                yield answers  # the caller stores them before the error arrives
                raise
            if time.perf_counter() - since > BATCH_S or answers[-1].result["status"] in FAILED:
                yield answers
                answers, since = [], time.perf_counter()
        if answers:
            yield answers


def local_launcher(experiment: Experiment, timed: bool = False, n_workers: int | None = None) -> Launcher:
    """Return a launcher that runs tasks in processes of this machine, or in this process if there are 0 workers.

    ``n_workers`` replaces the experiment's own setting. Timed tasks run one at a time and may use all cores, unless each has a process of its own.
    """
    rules = experiment.execution
    workers = rules.workers if n_workers is None else n_workers
    workers = (os.cpu_count() or 1) if workers is None else workers
    if not workers:
        return InProcessLauncher(TaskHandler(experiment, single_thread=not timed))
    limits = ResourceLimits(rules.timeout, rules.memory)
    return Pool(
        1 if timed else workers, TaskHandler, without_grid(experiment), limits,
        single_thread=not timed or study_of(experiment).fresh_process, folders=experiment.plugins, outside=lambda task: task.outside,
    )  # fmt: skip


def without_grid(experiment: Experiment) -> Experiment:
    """Return the experiment without its grid, which workers do not need since tasks contain their plugins."""
    return replace(experiment, choices={}, values={}, sweep={}, also=(), marks={})
