"""Runs tasks on the nodes of a Ray cluster, one job per node at a time; the tasks of a lost node run on another one.

A job is a list of tasks that a pool of local workers runs on its node. Its answers arrive one by one.
"""

from __future__ import annotations

import itertools
import logging
import os
import pickle
import socket
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
"""Part of a node's share of the tasks left that is one job, so that quick nodes get more of them."""
TOKEN = (
    "; ~/.ray/auth_token exists, so Ray authenticates by it here: start the cluster with RAY_AUTH_MODE=token and the same "
    "token, or set RAY_AUTH_MODE=disabled here"
)
"""The likely cause of a cluster that refuses this machine: Ray writes a token when it starts a cluster of this machine."""
MAX_LOSSES = 3
"""Number of losses of a node while it runs a task after which the task counts as crashed."""


@dataclass(frozen=True)
class RaySettings(Plugin):
    """The settings ``ray.*`` of an experiment."""

    kind: ClassVar[str] = "launchers"
    name: ClassVar[str] = "ray"

    address: str | None = param(None, "host and port of the cluster; null: RAY_ADDRESS, or a cluster of this machine")
    cells: int = param(50, "most cells of a job per core", low=1)


class RayLauncher:
    """Runs jobs on the nodes of a Ray cluster, each on all cores of its node; timed jobs run on nodes of one kind.

    Raises :class:`UserError` if Ray is not installed, no cluster runs, or no node is of kind ``kind``.
    """

    def __init__(self, experiment: Experiment, timed: bool, kind: str) -> None:
        self._settings = cast(RaySettings, build(RaySettings, experiment.execution.cluster))
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray warns if this is unset
        try:
            import ray
        except ImportError as error:
            raise UserError(
                f"launcher=ray is unavailable: {error}; pip install 'diffsim-bench[ray]' here and on the machines"
            ) from None
        self._ray: Any = ray
        self._timed, self._kind, self._folders = timed, kind, experiment.plugins
        self._experiment = replace(without_grid(experiment), results_dir=experiment.results_dir.absolute())
        self._jobs: dict[Any, tuple[str, dict[int, Task]]] = {}
        """The node and the unanswered tasks of each job, by the stream of its answers."""
        self._losses: Counter[int] = Counter()
        self._kinds: dict[str, str] = {}
        """The kinds of the machines, by node."""

    def __enter__(self) -> RayLauncher:
        address = self._settings.address or os.environ.get("RAY_ADDRESS")
        if address and address not in ("auto", "local"):
            reach(address)
        # absolute paths, so that other machines with the same folders can import this package
        inherited = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
        paths = [os.path.abspath(path) for path in (str(Path(__file__).resolve().parents[3]), *inherited)]
        try:
            self._ray.init(
                address=address, log_to_driver=False, logging_level=logging.ERROR,
                runtime_env={"env_vars": {"PYTHONPATH": os.pathsep.join(dict.fromkeys(paths))}},
            )  # fmt: skip
        except Exception as error:
            has_token = "RAY_AUTH_MODE" not in os.environ and (Path.home() / ".ray" / "auth_token").exists()
            raise UserError(
                f"no Ray cluster at {address or 'this machine'}: {printable(error)[:300]}; start one: ray start --head{TOKEN * has_token}"
            ) from None
        return self

    def __exit__(self, *_: object) -> None:
        for stream in self._jobs:
            with suppress(Exception):
                self._ray.cancel(stream, force=True)
        self._jobs.clear()
        self._ray.shutdown()

    @property
    def current(self) -> list[Task]:
        """The first unanswered task of each of the first four jobs."""
        return [next(iter(tasks.values())) for _, tasks in list(self._jobs.values())[:4] if tasks]

    def run(self, groups: Sequence[Sequence[Task]]) -> Iterator[list[Answer]]:
        """Yield answers as they arrive, one per task, and empty lists while the caller has to wait."""
        waiting = deque(list(group) for group in groups if group)
        while waiting or self._jobs:
            nodes = self._nodes() if waiting else {}
            busy = {node for node, _ in self._jobs.values()}
            for node, cores in nodes.items():
                if waiting and node not in busy:
                    share = -(-sum(map(len, waiting)) // (JOBS_PER_NODE * len(nodes)))
                    self._send(node, cores, first_tasks(waiting, min(self._settings.cells * cores, max(cores, share))))
            yield self._collect(waiting)

    def _nodes(self) -> dict[str, int]:
        """Return the number of cores of each node that may run jobs: of one kind, the first if none is given, if they are timed."""
        cores = {node["NodeID"]: int(node["Resources"].get("CPU", 0)) for node in self._ray.nodes() if node["Alive"]}
        nodes = {node: count for node, count in cores.items() if count}
        if self._timed:
            for node in [node for node in nodes if node not in self._kinds]:
                with suppress(self._ray.exceptions.RayError):
                    self._kinds[node] = self._ray.get(self._on(node, _kind_of_node, num_cpus=0).remote())
                    self._kind = self._kind or self._kinds[node]
            nodes = {node: count for node, count in nodes.items() if self._kinds.get(node) == self._kind}
        if not nodes:
            kind = f" of the kind '{self._kind}', as the times so far" if self._timed else ""
            raise UserError(
                f"the Ray cluster has no node{kind}; run the same command again when there is one, or choose another folder "
                "with name=..."
            )
        return nodes

    def _on(self, node: str, function: Any, **options: Any) -> Any:
        """Return a function as a Ray task on a node, which is not retried."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        place = NodeAffinitySchedulingStrategy(node, soft=False)
        return self._ray.remote(function).options(scheduling_strategy=place, max_retries=0, **options)

    def _send(self, node: str, cores: int, tasks: list[Task]) -> None:
        job = self._on(node, _run_job, num_cpus=cores, num_returns="streaming")
        stream = job.remote(self._folders, pickle.dumps((self._experiment, tasks)), self._timed, cores)
        self._jobs[stream] = node, dict(enumerate(tasks))

    def _collect(self, waiting: deque[list[Task]]) -> list[Answer]:
        """Return the answers that have arrived; the unanswered tasks of a lost job are put back into ``waiting``."""
        answers: list[Answer] = []
        ready, _ = self._ray.wait(list(self._jobs), num_returns=len(self._jobs), timeout=TICK)
        for stream in ready:
            try:
                answer = self._ray.get(next(stream))
            except self._ray.exceptions.RayTaskError as error:
                raise UserError(f"a job on the cluster failed: {printable(error.cause)[:300]}") from None
            except (StopIteration, self._ray.exceptions.RayError) as error:
                tasks = list(self._jobs.pop(stream)[1].values())
                self._losses.update(map(id, tasks[:1]))
                if tasks and self._losses[id(tasks[0])] == MAX_LOSSES:
                    reason = f"lost {MAX_LOSSES} times while it was running: {type(error).__name__}"
                    answers.append(Answer(tasks.pop(0), {"status": "crashed", "reason": reason}, 0.0))
                if tasks:
                    waiting.appendleft(tasks)
            else:
                answers.append(replace(answer, item=self._jobs[stream][1].pop(answer.item)))
        return answers


def first_tasks(waiting: deque[list[Task]], size: int) -> list[Task]:
    """Remove and return at most ``size`` tasks of the first group."""
    group = waiting.popleft()
    if group[size:]:
        waiting.appendleft(group[size:])
    return group[:size]


def _run_job(folders: Sequence[Path], job: bytes, timed: bool, cores: int) -> Iterator[Answer]:
    """Run tasks on this machine; yields their answers, with the index of the task as the item.

    Experiment and tasks are pickled, since their classes may come from ``folders``.
    """
    for folder in folders:
        registry.add_folder(folder)
    experiment, tasks = pickle.loads(job)
    index = {id(task): i for i, task in enumerate(tasks)}
    with local_launcher(experiment, timed, experiment.execution.workers or cores) as launcher:
        for answer in itertools.chain.from_iterable(launcher.run([tasks])):
            yield replace(answer, item=index[id(answer.item)], machine=kind_of_machine())


def _kind_of_node() -> str:
    """Return the kind of machine of the node; a separate function, since Ray does not accept a cached function."""
    return kind_of_machine()


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
