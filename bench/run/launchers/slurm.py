"""Runs tasks as jobs of a Slurm cluster: many short cells per job, which stores its own rows as they finish."""

from __future__ import annotations

import importlib
import math
import os
import pickle
import shlex
import shutil
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from bench.errors import UserError, printable
from bench.experiment.experiment import Experiment
from bench.run.launchers import jobs
from bench.run.pool import Answer
from bench.run.tasks import Task

TICK = 1.0
"""Seconds between looks at the jobs, and seconds in which the local executor is asked."""
LOST = 2
"""Times that a job may be lost before its first unanswered task is blamed."""


def _imported() -> Any:
    """Import submitit without its set-up of logging, which closes every handler there is, and some close their streams."""
    name, given = "SUBMITIT_LOG_LEVEL", os.environ.get("SUBMITIT_LOG_LEVEL")
    os.environ[name] = given or "NOCONFIG"
    try:
        return importlib.import_module("submitit")
    finally:
        if given is None:
            del os.environ[name]


class SlurmLauncher:
    """Jobs by submitit; timed ones run one after the other, each with a node to itself, all on one kind of machine."""

    def __init__(self, experiment: Experiment, timed: bool, kind: str) -> None:
        try:
            submitit = _imported()
        except ImportError as error:
            raise jobs.unavailable("slurm", error) from None
        self._submitit, self._experiment, self._timed, self._kind = submitit, experiment, timed, kind
        self._settings = experiment.execution.cluster
        self._folder = experiment.directory.absolute() / "jobs"
        self._sent: list[tuple[Any, list[Task]]] = []
        self._losses: dict[int, int] = {}

    def __enter__(self) -> SlurmLauncher:
        cluster = self._settings["cluster"]
        try:
            self._executor = self._submitit.AutoExecutor(folder=self._folder, cluster=cluster)
            self._executor.update_parameters(**parameters(self._experiment, self._timed, cluster))
        except (RuntimeError, ValueError, NameError) as error:
            raise UserError(f"launcher=slurm cannot send jobs: {printable(error)}") from None
        self._packed = jobs.packed(self._experiment)
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        for job, _ in self._sent:
            with suppress(Exception):
                job.cancel()
        self._sent.clear()
        if error is None:  # what is needed to look into a failure stays
            shutil.rmtree(self._folder, ignore_errors=True)

    @property
    def current(self) -> list[Task]:
        """The first task of some of the jobs."""
        return [tasks[0] for _, tasks in self._sent[:4]]

    def run(self, groups: Sequence[Sequence[Task]]) -> Iterator[list[Answer]]:
        """Yield answers when a job has ended, each task once, and an empty list now and then."""
        most = 1 if self._timed else self._settings["parallel"]
        waiting = deque(jobs.split(groups, self._settings["cells"], most))
        while waiting or self._sent:
            fresh = [waiting.popleft() for _ in range(min(len(waiting), most - len(self._sent)))]
            self._send(fresh)
            yield [answer for sent in list(self._sent) for answer in self._ended(sent, waiting)]

    def _send(self, parts: list[list[Task]]) -> None:
        if not parts:
            return
        made = [
            jobs.Job(
                self._experiment.plugins, self._packed, pickle.dumps(tasks), self._timed, self._kind,
                self._settings["cpus"], stores=True,
            ) for tasks in parts
        ]  # fmt: skip
        try:
            with self._executor.batch():  # one array of jobs, which a scheduler likes better than many jobs
                sent = [self._executor.submit(_all, job) for job in made]
        except Exception as error:
            raise UserError(f"the cluster takes no jobs: {printable(error)[:300]}") from None
        self._sent += list(zip(sent, parts, strict=True))

    def _ended(self, sent: tuple[Any, list[Task]], waiting: deque[list[Task]]) -> list[Answer]:
        job, tasks = sent
        if not job.done():
            time.sleep(TICK / max(1, len(self._sent)))
            return []
        self._sent.remove(sent)
        try:
            said = job.result()
        except self._submitit.core.utils.FailedJobError as error:
            raise UserError(f"a job failed, its output is in '{self._folder}': {printable(error)[-300:]}") from None
        except Exception as error:  # the node is lost, or its time was over
            return self._again(tasks, waiting, printable(error)[:200])
        found = []
        for place, one in said:
            found.append(jobs.answer(tasks[place], one, self._kind))
            self._kind = self._kind or one["machine"]
        return found

    def _again(self, tasks: list[Task], waiting: deque[list[Task]], why: str) -> list[Answer]:
        """Send what a lost job has not stored once more; after that its first task is blamed."""
        from bench.run.store import Store

        rows = Store(self._experiment.directory, self._experiment.columns, self._experiment.study.name).load()
        held = {row["key"]: row for row in rows.to_dict("records")}
        found, left = [], []
        for task in tasks:
            row = None if task.reference else held.get(task.cell.key)
            if row is None:
                left.append(task)
            else:
                found.append(Answer(task, {**row}, float(row["wall_s"]), "", row["machine"], stored=True))
        if left:
            self._losses[id(left[0])] = self._losses.get(id(left[0]), 0) + 1
            if self._losses[id(left[0])] >= LOST:
                reason = f"its job was lost {LOST} times while it was at work: {why}"
                found.append(Answer(left.pop(0), {"status": "crashed", "reason": reason}, 0.0))
        if left:
            waiting.appendleft(left)
        return found


def parameters(experiment: Experiment, timed: bool, cluster: str = "slurm") -> dict[str, Any]:
    """Return what submitit is asked for: time for all cells of a job, cores, memory, and an own node for timed cells."""
    given = experiment.execution.cluster
    memory = experiment.execution.memory
    asked: dict[str, Any] = {
        "name": "bench-" + experiment.name, "timeout_min": given["minutes"], "cpus_per_task": given["cpus"],
    }  # fmt: skip
    if cluster != "slurm":
        return asked
    if memory is not None:
        asked["mem_gb"] = math.ceil(1.25 * given["cpus"] * memory / 2**30)
    asked["slurm_array_parallelism"] = 1 if timed else given["parallel"]
    asked["slurm_setup"] = [f"export PYTHONPATH={shlex.quote(jobs.import_path())}"]
    more = {name: given[name] for name in ("partition", "constraint", "account", "qos") if given[name]}
    return (
        asked | {f"slurm_{name}": value for name, value in more.items()} | ({"slurm_exclusive": True} if timed else {})
    )


def script(experiment: Experiment) -> str:
    """Return the job script that would be sent; raises :class:`UserError` where submitit is not there."""
    try:
        _imported()
        from submitit.slurm.slurm import SlurmExecutor, _make_sbatch_string
    except ImportError as error:
        raise jobs.unavailable("slurm", error) from None
    folder = experiment.directory.absolute() / "jobs"
    asked = parameters(experiment, experiment.timing)
    names = {"name": "job_name", "timeout_min": "time", "mem_gb": "mem"}
    given = {names.get(name, name.removeprefix("slurm_")): value for name, value in asked.items()}
    if "mem" in given:
        given["mem"] = f"{given['mem']}GB"
    command = f"{shlex.quote(sys.executable)} -u -m submitit.core._submit {shlex.quote(str(folder))}"
    given = {
        name: value
        for name, value in given.items()
        if name in SlurmExecutor._valid_parameters() | {"array_parallelism"}
    }
    return str(_make_sbatch_string(command=command, folder=Path(folder), **given))


def _all(job: jobs.Job) -> list[tuple[int, dict[str, Any]]]:
    return list(jobs.answers(job))
