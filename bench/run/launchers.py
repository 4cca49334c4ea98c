"""Launchers, which run tasks in this process or in processes of this machine.

A launcher is a context manager that ends all its processes on exit. ``run(groups)`` yields answers as they arrive, one per
task, and empty lists while the caller has to wait; ``current`` are the tasks being worked on. The tasks of a group share a
compilation, and run in one worker unless another worker is idle.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

from bench.experiment.experiment import Experiment
from bench.run.pool import BATCH_S, Pool, TaskResult
from bench.run.tasks import FAILED, Task, TaskHandler


class InProcessLauncher:
    """Runs tasks in this process, without limits on time and memory, for debugging."""

    def __init__(self, handle: TaskHandler) -> None:
        self._handle = handle
        self.current: list[Task] = []

    def __enter__(self) -> InProcessLauncher:
        return self

    def __exit__(self, *_: object) -> None:
        self._handle.close()

    def run(self, groups: Iterable[Iterable[Task]]) -> Iterator[list[TaskResult]]:
        """Yield an empty list before each task, and answers after it; the answers of quick tasks are yielded together."""
        answers: list[TaskResult] = []
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
                answers.append(TaskResult(task, self._handle(task), time.perf_counter() - started))
            except BaseException:
                yield answers  # the caller stores them before the error arrives
                raise
            if time.perf_counter() - since > BATCH_S or answers[-1].result["status"] in FAILED:
                yield answers
                answers, since = [], time.perf_counter()
        if answers:
            yield answers


Launcher = Pool | InProcessLauncher


def launcher_of(experiment: Experiment, timed: bool = False) -> Launcher:
    """Return a launcher that runs tasks in processes of this machine, or in this process if there are 0 workers.

    Timed tasks run one at a time and may use all cores, unless each has a process of its own. Workers get the experiment without
    its grid, which they do not need since tasks contain their plugins.
    """
    rules = experiment.execution
    workers = (os.cpu_count() or 1) if rules.workers is None else rules.workers
    if not workers:
        return InProcessLauncher(TaskHandler(experiment, single_thread=not timed))
    return Pool(
        1 if timed else workers,
        TaskHandler,
        replace(experiment, choices={}, values={}, sweep={}, also=(), marks={}),
        rules,
        single_thread=not timed or experiment.study.fresh_process,
        folders=experiment.plugins,
        outside=lambda task: task.outside,
    )
