"""Runs tasks as jobs of a Slurm cluster: many short cells per job, and each job stores rows as their cells finish."""

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
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from bench.errors import UserError, printable
from bench.experiment.experiment import Experiment
from bench.run.launchers.jobs import Job, Losses, import_path, pack, read_message, run_job, split, unavailable
from bench.run.launchers.waiting import Patience
from bench.run.pool import Answer
from bench.run.store import Store
from bench.run.tasks import Task

TICK = 1.0
"""Seconds between checks of the jobs."""
PENDING = ("PENDING", "CONFIGURING", "UNKNOWN", "REQUEUED")
"""States of jobs that have not started."""
MAX_LOSSES = 2
"""Number of losses of a job after which its first unanswered task counts as crashed."""


def import_submitit() -> Any:
    """Import submitit without its logging setup, which would close all existing handlers and some of their streams."""
    name, level = "SUBMITIT_LOG_LEVEL", os.environ.get("SUBMITIT_LOG_LEVEL")
    os.environ[name] = level or "NOCONFIG"
    try:
        return importlib.import_module("submitit")
    finally:
        if level is None:
            del os.environ[name]


class SlurmLauncher:
    """Runs jobs through submitit. Timed jobs run one after another, on whole nodes of one kind."""

    def __init__(self, experiment: Experiment, timed: bool, kind: str) -> None:
        try:
            submitit = import_submitit()
        except ImportError as error:
            raise unavailable("slurm", error) from None
        self._submitit, self._experiment, self._timed, self._kind = submitit, experiment, timed, kind
        self._settings = experiment.execution.cluster
        self._folder = experiment.directory.absolute() / "jobs"
        self._jobs: list[tuple[Any, list[Task]]] = []
        self._losses = Losses(MAX_LOSSES)

    def __enter__(self) -> SlurmLauncher:
        cluster = self._settings["cluster"]
        try:
            self._executor = self._submitit.AutoExecutor(folder=self._folder, cluster=cluster)
            self._executor.update_parameters(**parameters(self._experiment, self._timed, cluster))
        except (RuntimeError, ValueError, NameError) as error:
            raise UserError(f"launcher=slurm cannot submit jobs: {printable(error)}") from None
        self._packed = pack(self._experiment)
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        for job, _ in self._jobs:
            with suppress(Exception):
                job.cancel()
        self._jobs.clear()
        if error is None:  # after a failure the output of the jobs is kept
            shutil.rmtree(self._folder, ignore_errors=True)

    @property
    def current(self) -> list[Task]:
        """The first task of each of the first four jobs."""
        return [tasks[0] for _, tasks in self._jobs[:4]]

    def run(self, groups: Sequence[Sequence[Task]]) -> Iterator[list[Answer]]:
        """Yield answers when a job has ended, one per task, and empty lists while the caller has to wait."""
        n_jobs = 1 if self._timed else self._settings["parallel"]
        waiting = deque(split(groups, self._settings["cells"], n_jobs))
        patience = self._patience()
        while waiting or self._jobs:
            self._submit([waiting.popleft() for _ in range(min(len(waiting), n_jobs - len(self._jobs)))])
            answers = [answer for job, tasks in list(self._jobs) for answer in self._collect(job, tasks, waiting)]
            if answers or any(job.state not in PENDING for job, _ in self._jobs):
                patience = self._patience()
            elif self._jobs:
                patience.wait(
                    f"none of {len(self._jobs)} jobs has started (job {self._jobs[0][0].job_id} is pending)",
                    "squeue shows the reason, and slurm.wait=null waits without a limit",
                )
            yield answers

    def _patience(self) -> Patience:
        return Patience(self._settings["wait"], "slurm.wait")

    def _submit(self, chunks: list[list[Task]]) -> None:
        if not chunks:
            return
        descriptions = [
            Job(
                self._experiment.plugins, self._packed, pickle.dumps(tasks), self._timed, self._kind,
                self._settings["cpus"], stores=True,
            ) for tasks in chunks
        ]  # fmt: skip
        try:
            # one array of jobs, which a scheduler handles better than many jobs
            with _errors_to(self._folder / "controller.txt"), self._executor.batch():
                jobs = [self._executor.submit(_run_job, description) for description in descriptions]
        except Exception as error:
            raise UserError(f"the cluster accepts no jobs: {printable(error)[:300]}") from None
        self._jobs += list(zip(jobs, chunks, strict=True))

    def _collect(self, job: Any, tasks: list[Task], waiting: deque[list[Task]]) -> list[Answer]:
        """Return the answers of a job that has ended, or none while it runs; the tasks of a lost job are requeued."""
        if not job.done():
            # each pass over all jobs takes one tick
            time.sleep(TICK / max(1, len(self._jobs)))
            return []
        self._jobs.remove((job, tasks))
        try:
            messages = job.result()
        except self._submitit.core.utils.FailedJobError as error:
            raise UserError(f"a job failed, its output is in '{self._folder}': {printable(error)[-300:]}") from None
        except Exception as error:  # the node is lost, or the job has reached its time limit
            return self._requeue(tasks, waiting, printable(error)[:200])
        answers = []
        for index, message in messages:
            answers.append(read_message(tasks[index], message, self._kind))
            self._kind = self._kind or message["machine"]
        return answers

    def _requeue(self, tasks: list[Task], waiting: deque[list[Task]], reason: str) -> list[Answer]:
        """Return a lost job's stored rows as answers, and requeue its other tasks."""
        table = Store(self._experiment.directory, self._experiment.columns, self._experiment.study.name).load()
        rows = {row["key"]: row for row in table.to_dict("records")}
        answers, unanswered = [], []
        for task in tasks:
            row = None if task.reference else rows.get(task.cell.key)
            if row is None:
                unanswered.append(task)
            else:
                answers.append(Answer(task, {**row}, float(row["wall_s"]), "", row["machine"], stored=True))
        return answers + self._losses.requeue(unanswered, waiting, reason)


@contextmanager
def _errors_to(path: Path) -> Iterator[None]:
    """Let the processes that are started meanwhile write to a file what they write to stderr.

    submitit's own processes on this machine would print a traceback on Ctrl-C.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    sys.stderr.flush()
    before, file = os.dup(2), os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    try:
        os.dup2(file, 2)
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)
        os.close(file)


def parameters(experiment: Experiment, timed: bool, cluster: str = "slurm") -> dict[str, Any]:
    """Return the parameters of a job for submitit: minutes, cores, memory in GB, and a whole node if cells are timed."""
    settings = experiment.execution.cluster
    memory = experiment.execution.memory
    request: dict[str, Any] = {
        "name": "bench-" + experiment.name, "timeout_min": settings["minutes"], "cpus_per_task": settings["cpus"],
    }  # fmt: skip
    if cluster != "slurm":
        return request
    if memory is not None:
        request["mem_gb"] = math.ceil(1.25 * settings["cpus"] * memory / 2**30)
    request["slurm_array_parallelism"] = 1 if timed else settings["parallel"]
    request["slurm_setup"] = [f"export PYTHONPATH={shlex.quote(import_path())}"]
    request |= {
        f"slurm_{name}": settings[name] for name in ("partition", "constraint", "account", "qos") if settings[name]
    }
    return request | ({"slurm_exclusive": True} if timed else {})


def script(experiment: Experiment) -> str:
    """Return the sbatch script of a job; raises :class:`UserError` if submitit is not installed."""
    try:
        import_submitit()
        from submitit.slurm.slurm import SlurmExecutor, _make_sbatch_string
    except ImportError as error:
        raise unavailable("slurm", error) from None
    folder = experiment.directory.absolute() / "jobs"
    request = parameters(experiment, experiment.timing)
    names = {"name": "job_name", "timeout_min": "time", "mem_gb": "mem"}
    given = {names.get(name, name.removeprefix("slurm_")): value for name, value in request.items()}
    if "mem" in given:
        given["mem"] = f"{given['mem']}GB"
    command = f"{shlex.quote(sys.executable)} -u -m submitit.core._submit {shlex.quote(str(folder))}"
    given = {
        name: value
        for name, value in given.items()
        if name in SlurmExecutor._valid_parameters() | {"array_parallelism"}
    }
    return str(_make_sbatch_string(command=command, folder=Path(folder), **given))


def _run_job(job: Job) -> list[tuple[int, dict[str, Any]]]:
    return list(run_job(job))
