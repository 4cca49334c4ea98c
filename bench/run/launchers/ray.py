"""Runs tasks as many small jobs on a Ray cluster; the tasks of a lost node run on another one."""

from __future__ import annotations

import logging
import os
import pickle
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from bench.errors import UserError, printable
from bench.experiment.experiment import Experiment
from bench.run.launchers.jobs import Job, Losses, import_path, pack, read_message, run_job, split, unavailable
from bench.run.launchers.waiting import PAUSE_S, Patience, reach
from bench.run.pool import Answer
from bench.run.record import kind_of_machine
from bench.run.tasks import Task

TICK = 0.1
"""Seconds between checks of the jobs."""
JOBS_PER_CORE = 2
"""Jobs sent per core: one runs, and another is ready to start."""
MAX_LOSSES = 3
"""Number of losses of a node while it runs a task after which the task counts as crashed."""


@dataclass(eq=False)
class _SentJob:
    """A job on the cluster: the stream of its answers, and the tasks without an answer by their index in the job."""

    stream: Any
    unanswered: dict[int, Task]
    node: str = ""


class RayLauncher:
    """Runs jobs on the nodes of a Ray cluster; timed jobs have a node to themselves, and all nodes are of one kind.

    Raises :class:`UserError` if Ray is not installed, no cluster runs, or no node is of kind ``kind``.
    """

    def __init__(self, experiment: Experiment, timed: bool, kind: str) -> None:
        try:
            os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray warns if this is unset
            import ray
        except ImportError as error:
            raise unavailable("ray", error) from None
        self._ray: Any = ray
        self._experiment, self._timed, self._kind = experiment, timed, kind
        self._settings = experiment.execution.cluster
        self._jobs: list[_SentJob] = []
        self._losses = Losses(MAX_LOSSES)
        self._has_started_ray = False

    def __enter__(self) -> RayLauncher:
        if not self._ray.is_initialized():
            address = self._settings["address"] or os.environ.get("RAY_ADDRESS")
            if address and address not in ("auto", "local"):
                reach(address, self._patience())
            try:
                self._ray.init(
                    address=address, log_to_driver=False, logging_level=logging.ERROR,
                    runtime_env={"env_vars": {"PYTHONPATH": import_path()}},
                )  # fmt: skip
            except Exception as error:
                raise UserError(
                    f"no Ray cluster at {address or 'this machine'}: {printable(error)[:300]}; start one: ray start --head"
                ) from None
            self._has_started_ray = True
        try:
            self._wait_for_cores()
        except BaseException:
            self.__exit__()
            raise
        self._packed = self._ray.put(pack(self._experiment))
        return self

    def __exit__(self, *_: object) -> None:
        for job in self._jobs:
            with suppress(Exception):
                self._ray.cancel(job.stream, force=True)
        self._jobs.clear()
        if self._has_started_ray:
            self._ray.shutdown()

    def _patience(self) -> Patience:
        return Patience(self._settings["wait"], "ray.wait")

    def _wait_for_cores(self) -> None:
        """Wait until a node has the cores of a job; raises :class:`UserError` after the limit."""
        patience, cpus = self._patience(), self._settings["cpus"]
        while (most := self._most_cores()) < cpus:
            patience.wait(f"a job reserves ray.cpus={cpus:g} cores, and the largest node of the cluster has {most:g}")
            time.sleep(PAUSE_S)

    def _most_cores(self) -> float:
        """Return the number of cores of the largest node."""
        return max((float(node["Resources"].get("CPU", 0)) for node in self._ray.nodes() if node["Alive"]), default=0.0)

    @property
    def current(self) -> list[Task]:
        """The first unanswered task of each of the first four jobs."""
        return [next(iter(job.unanswered.values())) for job in self._jobs[:4] if job.unanswered]

    def run(self, groups: Sequence[Sequence[Task]]) -> Iterator[list[Answer]]:
        """Yield answers as they arrive, one per task, and empty lists while the caller has to wait."""
        nodes = self._nodes_of_one_kind() if self._timed else {}
        n_slots = len(nodes) if self._timed else int(self._ray.cluster_resources().get("CPU", 1))
        waiting = deque(split(groups, self._settings["cells"], JOBS_PER_CORE * n_slots))
        patience: Patience | None = Patience(None)
        while waiting or self._jobs:
            if self._timed:
                alive = {node["NodeID"] for node in self._ray.nodes() if node["Alive"]}
                nodes = {node: cores for node, cores in nodes.items() if node in alive}
                if waiting and not nodes:
                    raise UserError(
                        f"no node of the kind '{self._kind}' is left; run the same command again when there is one"
                    )
                free = [node for node in nodes if all(job.node != node for job in self._jobs)]
                for node in free[: len(waiting)]:
                    self._send(waiting.popleft(), nodes[node], node)
            else:
                n_cores = int(self._ray.cluster_resources().get("CPU", 1))
                while waiting and len(self._jobs) < JOBS_PER_CORE * n_cores:
                    self._send(waiting.popleft(), self._settings["cpus"], "")
            answers = self._collect(waiting)
            if answers:
                patience = None
            elif patience is not None and self._ray.available_resources().get("CPU", 0) < self._settings["cpus"]:
                patience.wait("all cores of the Ray cluster are in use")
            yield answers

    def _send(self, tasks: list[Task], cores: float, node: str) -> None:
        options: dict[str, Any] = {"num_cpus": cores, "num_returns": "streaming", "max_retries": 0}
        options["scheduling_strategy"] = "SPREAD"
        if node:
            from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

            options["scheduling_strategy"] = NodeAffinitySchedulingStrategy(node, soft=False)
        send = self._ray.remote(_run_job).options(**options)
        settings = {"tasks": pickle.dumps(tasks), "timed": self._timed, "kind": self._kind}
        stream = send.remote(self._experiment.plugins, self._packed, settings)
        self._jobs.append(_SentJob(stream, dict(enumerate(tasks)), node))

    def _collect(self, waiting: deque[list[Task]]) -> list[Answer]:
        """Return the answers that have arrived; the unanswered tasks of a lost job are put back into ``waiting``."""
        if not self._jobs:
            time.sleep(TICK)
            return []
        answers: list[Answer] = []
        ready, _ = self._ray.wait([job.stream for job in self._jobs], num_returns=len(self._jobs), timeout=TICK)
        for job in [job for job in self._jobs if any(job.stream is stream for stream in ready)]:
            try:
                index, message = self._ray.get(next(job.stream))
            except self._ray.exceptions.RayTaskError as error:
                raise UserError(f"a job on the cluster failed: {printable(error.cause)[:300]}") from None
            except (StopIteration, self._ray.exceptions.RayError) as error:
                self._jobs.remove(job)
                reason = "its job ended early" if isinstance(error, StopIteration) else type(error).__name__
                answers += self._losses.requeue(list(job.unanswered.values()), waiting, reason)
            else:
                task = job.unanswered.pop(index, next(iter(job.unanswered.values())))
                answers.append(read_message(task, message, self._kind))
        return answers

    def _nodes_of_one_kind(self) -> dict[str, float]:
        """Return the core counts, by node, of the nodes for timed cells: of the required kind, else of the first node's."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        alive = {n["NodeID"]: n["Resources"].get("CPU", 0) for n in self._ray.nodes() if n["Alive"]}
        requests = {
            node: self._ray.remote(_kind_of_node)
            .options(num_cpus=0, scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False))
            .remote()
            for node, cores in alive.items()
            if cores >= 1
        }
        kinds: dict[str, str] = {}
        for node, request in requests.items():
            with suppress(self._ray.exceptions.RayError):
                kinds[node] = self._ray.get(request)
        if not kinds:
            raise UserError("the Ray cluster has no node with a core")
        self._kind = self._kind or next(iter(kinds.values()))
        nodes = {node: alive[node] for node, kind in kinds.items() if kind == self._kind}
        if not nodes:
            raise UserError(
                f"the stored times are from '{self._kind}', and the cluster has {', '.join(sorted(set(kinds.values())))}: times "
                "of two kinds are not mixed; choose another folder with name=..."
            )
        return nodes


def _run_job(folders: Any, experiment: bytes, settings: dict[str, Any]) -> Iterator[tuple[int, dict[str, Any]]]:
    yield from run_job(Job(folders, experiment, **settings))


def _kind_of_node() -> str:
    """Return the kind of machine of the node; a separate function, since Ray does not accept a cached function."""
    return kind_of_machine()
