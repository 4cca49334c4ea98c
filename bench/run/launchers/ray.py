"""Runs tasks on the nodes of a Ray cluster, one job per node at a time; the tasks of a lost node run on another one.

A job is a list of tasks that a pool of local workers runs on its node. Its answers arrive one by one.
"""

from __future__ import annotations

import itertools
import logging
import os
import pickle
import socket
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, cast

from bench.errors import UserError, printable
from bench.experiment.experiment import Experiment
from bench.model import registry
from bench.model.parameters import Plugin, build, param
from bench.run.launchers.launcher import local_launcher, without_grid
from bench.run.pool import Answer
from bench.run.record import kind_of_machine
from bench.run.tasks import Task

TICK = 0.1
"""Seconds between checks of the jobs."""
ANSWER_S = 10.0
"""Seconds in which a cluster answers."""
JOBS_PER_NODE = 4
"""Jobs into which a node's share of the tasks is cut, so that quick nodes get more of them."""
MAX_LOSSES = 3
"""Number of losses of a node while it runs a task after which the task counts as crashed."""


@dataclass(frozen=True)
class RaySettings(Plugin):
    """The settings ``ray.*`` of an experiment."""

    kind: ClassVar[str] = "launchers"
    name: ClassVar[str] = "ray"

    address: str | None = param(None, "host and port of the cluster; null: RAY_ADDRESS, or a cluster of this machine")
    cells: int = param(50, "most cells of a job per core", low=1)


@dataclass(eq=False)
class _SentJob:
    """A job on the cluster: the stream of its answers, and the tasks without an answer by their index in the job."""

    stream: Any
    unanswered: dict[int, Task]
    node: str


class RayLauncher:
    """Runs jobs on the nodes of a Ray cluster, each on all cores of its node; timed jobs run on nodes of one kind.

    Raises :class:`UserError` if Ray is not installed, no cluster runs, or no node is of kind ``kind``.
    """

    def __init__(self, experiment: Experiment, timed: bool, kind: str) -> None:
        self._settings = cast(RaySettings, build(RaySettings, experiment.execution.cluster))
        self._address = self._settings.address or os.environ.get("RAY_ADDRESS")
        try:
            os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray warns if this is unset
            import ray
        except ImportError as error:
            raise UserError(
                f"launcher=ray is unavailable: {error}; pip install 'diffsim-bench[ray]' here and on the machines"
            ) from None
        self._ray: Any = ray
        self._experiment, self._timed, self._kind = experiment, timed, kind
        self._jobs: list[_SentJob] = []
        self._losses: Counter[int] = Counter()
        self._has_started_ray = False

    def __enter__(self) -> RayLauncher:
        if not self._ray.is_initialized():
            if self._address and self._address not in ("auto", "local"):
                reach(self._address)
            try:
                self._ray.init(
                    address=self._address, log_to_driver=False, logging_level=logging.ERROR,
                    runtime_env={"env_vars": {"PYTHONPATH": _import_path()}},
                )  # fmt: skip
            except Exception as error:
                raise UserError(
                    f"no Ray cluster at {self._address or 'this machine'}: {printable(error)[:300]}; start one: ray start --head"
                ) from None
            self._has_started_ray = True
        folder = self._experiment.results_dir.absolute()
        self._packed = self._ray.put(pickle.dumps(replace(without_grid(self._experiment), results_dir=folder)))
        return self

    def __exit__(self, *_: object) -> None:
        for job in self._jobs:
            with suppress(Exception):
                self._ray.cancel(job.stream, force=True)
        self._jobs.clear()
        if self._has_started_ray:
            self._ray.shutdown()

    @property
    def _cores(self) -> dict[str, int]:
        """The number of cores of each node that has some, by the node's id."""
        cores = {node["NodeID"]: int(node["Resources"].get("CPU", 0)) for node in self._ray.nodes() if node["Alive"]}
        return {node: count for node, count in cores.items() if count}

    @property
    def current(self) -> list[Task]:
        """The first unanswered task of each of the first four jobs."""
        return [next(iter(job.unanswered.values())) for job in self._jobs[:4] if job.unanswered]

    def run(self, groups: Sequence[Sequence[Task]]) -> Iterator[list[Answer]]:
        """Yield answers as they arrive, one per task, and empty lists while the caller has to wait."""
        chosen = self._of_one_kind() if self._timed else None
        waiting = deque(split(groups, self._settings.cells, list(self._cores.values())))
        while waiting or self._jobs:
            nodes = {node: n for node, n in self._cores.items() if chosen is None or node in chosen}
            if waiting and not nodes:
                kind = f" of the kind '{self._kind}'" if self._timed else ""
                raise UserError(f"no node{kind} is left; run the same command again when there is one")
            free = nodes.keys() - {job.node for job in self._jobs}
            for node in list(free)[: len(waiting)]:
                self._send(waiting.popleft(), nodes[node], node)
            yield self._collect(waiting)

    def _send(self, tasks: list[Task], cores: int, node: str) -> None:
        job = self._ray.remote(_run_job).options(
            num_cpus=cores, num_returns="streaming", max_retries=0, scheduling_strategy=self._only_on(node)
        )
        stream = job.remote(self._experiment.plugins, self._packed, pickle.dumps(tasks), self._timed, cores)
        self._jobs.append(_SentJob(stream, dict(enumerate(tasks)), node))

    def _only_on(self, node: str) -> Any:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        return NodeAffinitySchedulingStrategy(node, soft=False)

    def _collect(self, waiting: deque[list[Task]]) -> list[Answer]:
        """Return the answers that have arrived; the unanswered tasks of a lost job are put back into ``waiting``."""
        if not self._jobs:
            time.sleep(TICK)
            return []
        answers: list[Answer] = []
        ready, _ = self._ray.wait([job.stream for job in self._jobs], num_returns=len(self._jobs), timeout=TICK)
        for job in [job for job in self._jobs if any(job.stream is stream for stream in ready)]:
            try:
                index, answer = self._ray.get(next(job.stream))
            except self._ray.exceptions.RayTaskError as error:
                raise UserError(f"a job on the cluster failed: {printable(error.cause)[:300]}") from None
            except (StopIteration, self._ray.exceptions.RayError) as error:
                self._jobs.remove(job)
                tasks = list(job.unanswered.values())
                self._losses.update(map(id, tasks[:1]))
                if tasks and self._losses[id(tasks[0])] == MAX_LOSSES:
                    cause = "its job ended early" if isinstance(error, StopIteration) else type(error).__name__
                    reason = f"lost {MAX_LOSSES} times while it was running: {cause}"
                    answers.append(Answer(tasks.pop(0), {"status": "crashed", "reason": reason}, 0.0))
                if tasks:
                    waiting.appendleft(tasks)
            else:
                answers.append(Answer(job.unanswered.pop(index), **answer))
        return answers

    def _of_one_kind(self) -> set[str]:
        """Return the nodes for timed cells: those of the required kind, else of the first node's."""
        requests = {
            node: self._ray.remote(_kind_of_node).options(num_cpus=0, scheduling_strategy=self._only_on(node)).remote()
            for node in self._cores
        }
        kinds: dict[str, str] = {}
        for node, request in requests.items():
            with suppress(self._ray.exceptions.RayError):
                kinds[node] = self._ray.get(request)
        if not kinds:
            raise UserError("the Ray cluster has no node with a core")
        self._kind = self._kind or next(iter(kinds.values()))
        nodes = {node for node, kind in kinds.items() if kind == self._kind}
        if not nodes:
            raise UserError(
                f"the stored times are from '{self._kind}', and the cluster has {', '.join(sorted(set(kinds.values())))}: times "
                "of two kinds are not mixed; choose another folder with name=..."
            )
        return nodes


def split(groups: Sequence[Sequence[Task]], cells: int, cores: Sequence[int]) -> list[list[Task]]:
    """Split groups into jobs of at most ``cells`` tasks per core of the largest node, smaller if nodes would stay idle."""
    n_tasks, most = sum(map(len, groups)), max(cores, default=1)
    size = min(cells * most, max(most, -(-n_tasks // (JOBS_PER_NODE * len(cores) or 1))))
    return [list(group[i : i + size]) for group in groups for i in range(0, len(group), size)]


def _run_job(
    folders: Sequence[Path], experiment: bytes, tasks: bytes, timed: bool, cores: int
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Run tasks on this machine; yields the index of each task and the fields of its answer.

    Experiment and tasks are pickled, since their classes may come from ``folders``.
    """
    for folder in folders:
        registry.add_folder(folder)
    own: list[Task] = pickle.loads(tasks)
    index = {id(task): i for i, task in enumerate(own)}
    given: Experiment = pickle.loads(experiment)
    with local_launcher(given, timed, given.execution.workers or cores) as launcher:
        for a in itertools.chain.from_iterable(launcher.run([own])):
            answer = {"result": a.result, "seconds": a.seconds, "output": a.output, "machine": kind_of_machine()}
            yield index[id(a.item)], answer


def _kind_of_node() -> str:
    """Return the kind of machine of the node; a separate function, since Ray does not accept a cached function."""
    return kind_of_machine()


def _import_path() -> str:
    """Return a PYTHONPATH of absolute paths, so that other machines with the same folders can import this package."""
    inherited = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    package = Path(__file__).resolve().parents[3]
    return os.pathsep.join(dict.fromkeys([str(package), *(str(Path(path).absolute()) for path in inherited if path)]))


def reach(address: str) -> None:
    """Open a TCP connection to ``HOST:PORT`` and close it; raises :class:`UserError` if there is no such place, or no answer."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise UserError(f"ray.address={printable(address)} must be HOST:PORT, for example 10.0.0.1:6379")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWER_S).close()
    except (OSError, UnicodeError) as error:
        raise UserError(
            f"no Ray cluster answers at {printable(address)} ({printable(error)}); start one: ray start --head"
        ) from None
