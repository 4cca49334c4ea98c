"""Runs tasks on a Ray cluster: many small jobs, and what a lost node had at work is run elsewhere."""

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
from bench.run.launchers import jobs
from bench.run.pool import Answer
from bench.run.tasks import Task

TICK = 0.1
"""Seconds between looks at the jobs."""
AHEAD = 2
"""Jobs sent per core: one at work and one that need not be waited for."""
LOST = 3
"""Times that the same task may be at work on a node that is lost, before it is blamed."""


@dataclass(eq=False)
class _Sent:
    """A job at work: its answers to come, and the tasks that have none yet."""

    stream: Any
    left: dict[int, Task]
    node: str = ""


class RayLauncher:
    """Jobs on the nodes of a Ray cluster; timed ones have a node to themselves, and all nodes are of one kind.

    Raises :class:`UserError` where Ray or its cluster is not there, and where no node of the kind is.
    """

    def __init__(self, experiment: Experiment, timed: bool, kind: str) -> None:
        try:
            os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # a choice that it warns about otherwise
            import ray
        except ImportError as error:
            raise jobs.unavailable("ray", error) from None
        self._ray, self._experiment, self._timed, self._kind = ray, experiment, timed, kind
        self._settings = experiment.execution.cluster
        self._sent: list[_Sent] = []
        self._losses: dict[int, int] = {}
        self._ours = False

    def __enter__(self) -> RayLauncher:
        if not self._ray.is_initialized():
            address = self._settings["address"] or os.environ.get("RAY_ADDRESS")
            try:
                self._ray.init(
                    address=address, log_to_driver=False, logging_level=logging.ERROR,
                    runtime_env={"env_vars": {"PYTHONPATH": jobs.import_path()}},
                )  # fmt: skip
            except Exception as error:
                said = printable(error)[:300]
                raise UserError(
                    f"no Ray cluster at {address or 'this machine'}: {said}; start one: ray start --head"
                ) from None
            self._ours = True
        self._packed = self._ray.put(jobs.packed(self._experiment))
        return self

    def __exit__(self, *_: object) -> None:
        for sent in self._sent:
            with suppress(Exception):
                self._ray.cancel(sent.stream, force=True)
        self._sent.clear()
        if self._ours:
            self._ray.shutdown()

    @property
    def current(self) -> list[Task]:
        """The first task without an answer of some of the jobs."""
        return [next(iter(sent.left.values())) for sent in self._sent[:4] if sent.left]

    def run(self, groups: Sequence[Sequence[Task]]) -> Iterator[list[Answer]]:
        """Yield answers as they come, each task once, and an empty list now and then."""
        nodes = self._nodes_of_a_kind() if self._timed else {}
        slots = len(nodes) if self._timed else int(self._ray.cluster_resources().get("CPU", 1))
        waiting = deque(jobs.split(groups, self._settings["cells"], AHEAD * slots))
        while waiting or self._sent:
            if self._timed:
                alive = {node["NodeID"] for node in self._ray.nodes() if node["Alive"]}
                nodes = {node: cores for node, cores in nodes.items() if node in alive}
                if waiting and not nodes:
                    raise UserError(
                        f"no node of the kind '{self._kind}' is left; the same command goes on when there is one"
                    )
                free = [node for node in nodes if all(sent.node != node for sent in self._sent)]
                for node in free[: len(waiting)]:
                    self._send(waiting.popleft(), nodes[node], node)
            else:
                cores = int(self._ray.cluster_resources().get("CPU", 1))
                while waiting and len(self._sent) < AHEAD * cores:
                    self._send(waiting.popleft(), self._settings["cpus"], "")
            yield self._collect(waiting)

    def _send(self, tasks: list[Task], cores: float, node: str) -> None:
        options: dict[str, Any] = {"num_cpus": cores, "num_returns": "streaming", "max_retries": 0}
        options["scheduling_strategy"] = "SPREAD"
        if node:
            from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

            options["scheduling_strategy"] = NodeAffinitySchedulingStrategy(node, soft=False)
        send = self._ray.remote(_answers).options(**options)
        rest = {"tasks": pickle.dumps(tasks), "timed": self._timed, "kind": self._kind}
        stream = send.remote(self._experiment.plugins, self._packed, rest)
        self._sent.append(_Sent(stream, dict(enumerate(tasks)), node))

    def _collect(self, waiting: deque[list[Task]]) -> list[Answer]:
        """Return the answers that have come; what a lost job had left is sent again."""
        if not self._sent:
            time.sleep(TICK)
            return []
        found: list[Answer] = []
        ready, _ = self._ray.wait([s.stream for s in self._sent], num_returns=len(self._sent), timeout=TICK)
        for sent in [s for s in self._sent if any(s.stream is stream for stream in ready)]:
            try:
                place, said = self._ray.get(next(sent.stream))
            except StopIteration:
                self._sent.remove(sent)
                self._again(sent, waiting, found, "it ended early")
            except self._ray.exceptions.RayTaskError as error:
                raise UserError(f"a job on the cluster failed: {printable(error.cause)[:300]}") from None
            except self._ray.exceptions.RayError as error:
                self._sent.remove(sent)
                self._again(sent, waiting, found, type(error).__name__)
            else:
                found.append(jobs.answer(sent.left.pop(place, next(iter(sent.left.values()))), said, self._kind))
        return found

    def _again(self, sent: _Sent, waiting: deque[list[Task]], found: list[Answer], why: str) -> None:
        left = list(sent.left.values())
        if not left:
            return
        first = left[0]
        self._losses[id(first)] = self._losses.get(id(first), 0) + 1
        if self._losses[id(first)] >= LOST:
            reason = f"its node or worker was lost {LOST} times while it was at work ({why})"
            found.append(Answer(left.pop(0), {"status": "crashed", "reason": reason}, 0.0))
        if left:
            waiting.appendleft(left)

    def _nodes_of_a_kind(self) -> dict[str, float]:
        """Return the nodes on which times may be measured, with their cores; the first node chooses where none is stored."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        alive = {n["NodeID"]: n["Resources"].get("CPU", 0) for n in self._ray.nodes() if n["Alive"]}
        asked = {
            node: self._ray.remote(_kind)
            .options(num_cpus=0, scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False))
            .remote()
            for node, cores in alive.items()
            if cores >= 1
        }
        kinds: dict[str, str] = {}
        for node, one in asked.items():
            with suppress(self._ray.exceptions.RayError):
                kinds[node] = self._ray.get(one)
        if not kinds:
            raise UserError("the Ray cluster has no node with a core")
        self._kind = self._kind or next(iter(kinds.values()))
        nodes = {node: alive[node] for node, kind in kinds.items() if kind == self._kind}
        if not nodes:
            raise UserError(
                f"the stored times are of '{self._kind}', and the cluster has {', '.join(sorted(set(kinds.values())))}: times of "
                "two kinds are not mixed; choose another folder with name=..."
            )
        return nodes


def _answers(folders: Any, experiment: bytes, rest: dict[str, Any]) -> Iterator[tuple[int, dict[str, Any]]]:
    yield from jobs.answers(jobs.Job(folders, experiment, **rest))


def _kind() -> str:
    from bench.experiment.machine import kind_of_machine

    return kind_of_machine()
