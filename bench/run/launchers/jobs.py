"""Jobs: chunks of a sweep that run on another machine and stream their results back."""

from __future__ import annotations

import itertools
import os
import pickle
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench.errors import UserError
from bench.experiment.experiment import Experiment
from bench.model import registry
from bench.run.launchers.launcher import local_launcher, without_grid
from bench.run.pool import Answer
from bench.run.record import kind_of_machine
from bench.run.tasks import Task

WRONG_KIND = "wrong_kind"
"""Key of a message from a machine of another kind than the sweep's timed rows; its value is that machine's kind."""


@dataclass(frozen=True)
class Job:
    """Tasks with everything that another machine needs to run them.

    Experiment and tasks are pickled separately, since their classes may come from ``folders``.
    """

    folders: tuple[Path, ...]
    experiment: bytes
    tasks: bytes
    timed: bool
    kind: str
    """The kind of machine that timed tasks need; empty for any."""


def pack(experiment: Experiment) -> bytes:
    """Return the experiment pickled for a job, without its grid and with an absolute results folder."""
    return pickle.dumps(replace(without_grid(experiment), results_dir=experiment.results_dir.absolute()))


def split(groups: Sequence[Sequence[Task]], max_tasks: int, n_slots: int) -> list[list[Task]]:
    """Split groups into chunks of at most ``max_tasks`` tasks, smaller if slots would stay idle."""
    n_tasks = sum(map(len, groups))
    size = max(1, min(max_tasks, -(-n_tasks // max(1, n_slots))))
    return [list(group[i : i + size]) for group in groups for i in range(0, len(group), size)]


def run_job(job: Job) -> Iterator[tuple[int, dict[str, Any]]]:
    """Run a job on this machine; yields the index of each task and a message for :func:`read_message`."""
    for folder in job.folders:
        registry.add_folder(folder)
    experiment: Experiment = pickle.loads(job.experiment)
    tasks: list[Task] = pickle.loads(job.tasks)
    kind = kind_of_machine()
    if job.timed and job.kind not in ("", kind):
        yield -1, {WRONG_KIND: kind}
        return
    index = {id(task): i for i, task in enumerate(tasks)}
    with local_launcher(experiment, job.timed, n_workers=1) as launcher:
        for a in itertools.chain.from_iterable(launcher.run([tasks])):
            yield index[id(a.item)], {"result": a.result, "seconds": a.seconds, "output": a.output, "machine": kind}


def read_message(task: Task, message: dict[str, Any], kind: str) -> Answer:
    """Return the answer in a job's message; raises :class:`UserError` if it ran on another kind of machine."""
    if WRONG_KIND in message:
        raise UserError(
            f"a job ran on a machine of another kind ({message[WRONG_KIND]}) than the times of this sweep ({kind}), and times "
            "of two kinds are not mixed: restrict the jobs to one kind, or choose another folder with name=..."
        )
    return Answer(task, **message)


class Losses:
    """Counts lost jobs. A task that is the first unanswered task of ``limit`` lost jobs counts as crashed."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._counts: Counter[int] = Counter()

    def requeue(self, tasks: list[Task], waiting: deque[list[Task]], reason: str) -> list[Answer]:
        """Put the unanswered tasks of a lost job at the front of ``waiting``; returns the answer of a crashed task."""
        answers: list[Answer] = []
        if tasks:
            self._counts[id(tasks[0])] += 1
            if self._counts[id(tasks[0])] >= self._limit:
                result = {"status": "crashed", "reason": f"lost {self._limit} times while it was running: {reason}"}
                answers.append(Answer(tasks[0], result, 0.0))
                tasks = tasks[1:]
        if tasks:
            waiting.appendleft(tasks)
        return answers


def import_path() -> str:
    """Return a PYTHONPATH of absolute paths, so that other machines with the same folders can import this package."""
    inherited = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    package = Path(__file__).resolve().parents[3]
    return os.pathsep.join(dict.fromkeys([str(package), *(str(Path(path).absolute()) for path in inherited if path)]))


def unavailable(library: str, error: ImportError) -> UserError:
    """Return the error for a launcher whose library is not installed."""
    return UserError(
        f"launcher={library} is unavailable: {error}; pip install 'diffsim-bench[{library}]' here and on the machines"
    )
