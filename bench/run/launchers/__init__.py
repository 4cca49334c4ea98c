"""Launchers: where tasks run. All of them run the same tasks and give the same rows, and any resumes any other's sweep."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import TracebackType
from typing import Any, Protocol

from bench.experiment.experiment import Experiment
from bench.run.pool import Answer, Pool, ResourceLimits
from bench.run.tasks import InProcessPool, Measure, Task

NAMES = ("local", "ray", "slurm")


class Launcher(Protocol):
    """Runs groups of tasks: a context manager that leaves nothing running."""

    def __enter__(self) -> Launcher: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> Any: ...

    def run(self, groups: Sequence[Sequence[Task]]) -> Iterator[list[Answer]]:
        """Yield answers as they come, each task once, and an empty list now and then.

        The tasks of a group share what is compiled, and go to one worker while that pays.
        """

    @property
    def current(self) -> list[Task]:
        """The tasks being worked on."""


def of(experiment: Experiment, timed: bool = False, kind: str = "") -> Launcher:
    """Return the experiment's launcher.

    Timed tasks run one at a time with a machine to themselves, on machines of the given kind or, where none is given, of
    the kind of the first one; others run side by side, each on one thread.
    """
    rules = experiment.execution
    if rules.launcher == "ray":
        from bench.run.launchers.ray import RayLauncher

        return RayLauncher(experiment, timed, kind)
    if rules.launcher == "slurm":
        from bench.run.launchers.slurm import SlurmLauncher

        return SlurmLauncher(experiment, timed, kind)
    return local(experiment, timed)


def local(experiment: Experiment, timed: bool = False, count: int | None = None) -> Launcher:
    """Return workers of this machine, ``count`` of them unless the tasks are timed; with ``workers=0`` this process."""
    rules = experiment.execution
    workers = rules.workers if count is None else count
    workers = (os.cpu_count() or 1) if workers is None else workers
    if not workers:
        return InProcessPool(Measure(experiment))
    # tasks bring their own plugins, so workers need no grid
    lean = replace(experiment, choices={}, values={}, sweep={}, marks={})
    limits = ResourceLimits(rules.timeout, rules.memory)
    return Pool(1 if timed else workers, Measure, lean, limits, single=not timed, folders=experiment.plugins)
