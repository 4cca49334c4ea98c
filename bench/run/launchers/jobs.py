"""Jobs: parts of a sweep that go to another machine, run there by workers of its own, and come back answer by answer."""

from __future__ import annotations

import os
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench.errors import UserError
from bench.experiment.experiment import Experiment
from bench.experiment.machine import kind_of_machine
from bench.model import registry
from bench.run.pool import Answer
from bench.run.store import Store
from bench.run.tasks import Task, explained, row_of

ELSEWHERE = "elsewhere"
"""Entry of an answer from a machine of another kind than the sweep's times are of."""


@dataclass(frozen=True)
class Job:
    """Tasks with all that another machine needs to run them; pickled parts, as their classes may be in ``folders``."""

    folders: tuple[Path, ...]
    experiment: bytes
    tasks: bytes
    timed: bool
    kind: str
    """The kind of machine that timed tasks are for; empty for any."""
    workers: int = 1
    stores: bool = False
    """Whether the job stores its rows, so that they are kept when the run that sent it has gone."""


def packed(experiment: Experiment) -> bytes:
    """Return the experiment as jobs need it: without its grid, and with folders that mean the same everywhere."""
    lean = replace(experiment, choices={}, values={}, sweep={}, marks={}, results_dir=experiment.results_dir.absolute())
    return pickle.dumps(lean)


def split(groups: Sequence[Sequence[Task]], most: int, slots: int) -> list[list[Task]]:
    """Cut groups into parts of at most ``most`` tasks, and smaller where the slots would not all get one."""
    total = sum(map(len, groups))
    size = max(1, min(most, -(-total // max(1, slots))))
    return [list(group[i : i + size]) for group in groups for i in range(0, len(group), size)]


def answers(job: Job) -> Iterator[tuple[int, dict[str, Any]]]:
    """Run a job on this machine; yields the place of each task in it and its answer, as they come."""
    from bench.run.launchers import local

    for folder in job.folders:
        registry.add_folder(folder)
    experiment: Experiment = pickle.loads(job.experiment)
    tasks: list[Task] = pickle.loads(job.tasks)
    kind = kind_of_machine()
    if job.timed and job.kind not in ("", kind):
        yield -1, {ELSEWHERE: kind}
        return
    place = {id(task): index for index, task in enumerate(tasks)}
    store = Store(experiment.directory, experiment.columns, experiment.study.name) if job.stores else None
    with local(experiment, job.timed, job.workers) as pool:
        for some in pool.run([tasks]):
            rows = [row_of(experiment, a.item.cell, explained(a)) for a in some if not a.item.reference]
            if rows and store is not None:
                store.append(*rows)
            for a in some:
                kept = {"result": a.result, "seconds": a.seconds, "output": a.output, "machine": kind}
                yield place[id(a.item)], kept | {"stored": store is not None and not a.item.reference}


def answer(task: Task, said: dict[str, Any], kind: str) -> Answer:
    """Return what a job said of a task; raises :class:`UserError` where it was on another kind of machine."""
    if ELSEWHERE in said:
        raise UserError(
            f"a job came to a machine of another kind ({said[ELSEWHERE]}) than the times of this sweep ({kind}), and times of "
            "two kinds are not mixed: pin the jobs to one kind, or choose another folder with name=..."
        )
    return Answer(task, **said)


def import_path() -> str:
    """Return where other machines find this package, as PYTHONPATH: they see the same folders."""
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    own = Path(__file__).resolve().parents[3]
    return os.pathsep.join(dict.fromkeys([str(own), *(str(Path(path).absolute()) for path in given if path)]))


def unavailable(library: str, error: ImportError) -> UserError:
    """Make the error of a launcher whose library is not there."""
    return UserError(
        f"launcher={library} is unavailable: {error}; pip install 'diffsim-bench[{library}]' here and on the machines"
    )
