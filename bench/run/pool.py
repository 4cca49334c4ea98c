"""Runs items in worker processes, one item at a time, with limits on the time and memory of each item.

A worker is a process in its own session. It builds a handler once and then handles items as they arrive, so that imports
and compilations happen once. It answers in JSON over a socket of its own, and what it prints goes to a file: nothing that
a worker sends is executed here. (Pools of the standard library lose all their items when one worker dies.)
"""

from __future__ import annotations

import json
import math
import os
import pickle
import signal
import socket
import struct
import subprocess
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import IO, Any, Literal

import psutil

from bench.errors import STATUSES, StorageError, UserError, describe_exit, failure
from bench.experiment.experiment import Execution
from bench.host import guard
from bench.model import registry
from bench.run.reaper import MARK, Reaper, kill_marked_processes
from bench.run.worker import Handler, command

BATCH_S = 0.05
"""Seconds for which the answers of quick items are gathered, to be stored in one file: syncing takes longer than a small cell."""
TAIL, MOST_OUTPUT = 16000, 1 << 26
"""Bytes that are read of the end of a worker's printed output, and bytes of a file of output that is emptied."""
EXIT_S = 5.0
"""Seconds allowed for the rest of a message to arrive, and for a process to end after it has closed its connection."""
LOST = "closed its connection"
"""The fault of a worker that has ended."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC")
"""Environment variables that limit the threads of numerical libraries, if set before the libraries are imported."""


@dataclass(frozen=True)
class TaskResult:
    """The result of an item, or the reason why it has none."""

    item: Any
    result: dict[str, Any]
    """The handler's result; ``status`` and ``reason`` if the worker was killed or died."""
    seconds: float
    output: str = ""
    """The last lines printed while the item was handled."""


# ---------------------------------------------------------------------------------------------------------- a worker


@dataclass(eq=False)
class _Worker:
    process: subprocess.Popen[bytes]
    connection: Connection
    output: IO[bytes]
    """The file of its printed output."""
    usage: psutil.Process
    mark: str
    queue: deque[Any] = field(default_factory=deque)
    """Items to send to the worker."""
    item: Any = None
    """The item that it works on; None while it waits."""
    since: float = field(default_factory=time.monotonic)
    """Monotonic time in seconds at which the item was sent or, once its imports are done, was started."""
    is_ready: bool = False
    """Whether it has built its handler."""
    is_prepared: bool = False
    """Whether it has imported the libraries of the item, so that the item's own time has begun."""
    checked: float = 0.0
    """Monotonic time in seconds at which its limits were last checked."""
    children: list[psutil.Process] = field(default_factory=list)
    """The processes that it had started when they were last searched for."""
    children_since: float = 0.0
    """Monotonic time in seconds of that search."""
    pace: float = 1.0
    """Seconds that the last item took."""
    n_answered: int = 0
    outside: frozenset[str] = frozenset()
    """The modules from outside whose code it has run."""
    is_done: bool = False
    """Whether it handles no more items, since a plugin has changed its process."""
    fault: str = ""
    """What is wrong with its connection or its last message."""

    def resident_bytes(self) -> int:
        """Return the resident memory of the worker and of the processes that it has started, such as engines."""
        now = time.monotonic()
        # seconds between searches for the processes that a worker has started, whose memory counts as the
        # worker's
        if now > self.children_since + 1.0:
            # a search through all processes, so not at each check
            self.children, self.children_since = self.usage.children(recursive=True), now
        total = int(self.usage.memory_info().rss)
        for child in self.children:
            with suppress(psutil.Error):
                total += int(child.memory_info().rss)
        return total

    def send(self, message: bytes) -> None:
        """Send a message to the worker, which waits for it."""
        try:
            self.connection.send_bytes(message)
        except OSError:
            self.fault = LOST

    def send_next(self) -> TaskResult | None:
        """Send the next item of the queue; returns an answer with the failure if the item cannot be pickled."""
        item = self.queue.popleft()
        try:
            message = pickle.dumps(item)
        except Exception as error:
            return TaskResult(item, dict(failure(error)), 0.0)
        self.item, self.is_prepared, self.since = item, False, time.monotonic()
        self.send(message)
        return None

    def take_output(self) -> str:
        """Return the last lines printed since the last call, or the first lines of Python's crash dump, joined by ``|``."""
        size = os.fstat(self.output.fileno()).st_size
        if not size:
            return ""
        output = os.pread(self.output.fileno(), TAIL, max(0, size - TAIL))
        os.ftruncate(self.output.fileno(), 0)
        _, crash, dump = output.decode(errors="replace").rpartition("(most recent call first):")
        printable = ("".join(c for c in line if c.isprintable()).strip() for line in dump.split("\n"))
        lines = [line for line in printable if line]
        return " | ".join(lines[:3] if crash else lines[-4:])[-600:]

    def receive(self) -> list[TaskResult]:
        """Return the answers that have arrived. A fault of the connection or of a message is stored in ``fault``."""
        answers: list[TaskResult] = []
        try:
            while not self.fault and self.connection.poll():
                answers += self._read(self.connection.recv_bytes(1 << 30))
        except (EOFError, ConnectionError):
            self.fault = LOST
        except StorageError:
            raise
        except Exception:  # no message, or it is longer than 1 GiB, or its rest did not arrive
            self.fault = "sent a malformed message"
        return answers

    def _read(self, message: bytes) -> list[TaskResult]:
        """Return the answers in a message, one or none; raises :class:`StorageError`, and any error if it is malformed."""
        content = json.loads(message)
        match content["event"]:
            case "ready":
                self.is_ready = True
            case "started":
                self.since, self.is_prepared = time.monotonic(), True
            case "storage":
                raise StorageError(content["reason"])
            case "answer" if self.item is not None:
                result, seconds = dict(content["result"]), float(content["seconds"])
                is_text = isinstance(result.get("reason", ""), str)
                if result["status"] not in STATUSES or not is_text or not 0 <= seconds < math.inf:
                    raise ValueError("an answer has a status, a reason and a time")
                item, self.item, self.pace = self.item, None, seconds
                self.is_done = content.get("is_last") is True
                self.n_answered += 1
                return [TaskResult(item, result, seconds, self.take_output())]
            case event:
                raise ValueError(f"unknown event {event}")
        return []

    def kill(self) -> None:
        """Kill the worker and all processes that it has started."""
        with suppress(psutil.Error):
            self.children += self.usage.children(recursive=True)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.kill()
        self.process.wait()
        for child in self.children:
            with suppress(psutil.Error):
                child.kill()
        kill_marked_processes(self.mark)

    def close(self) -> None:
        """Close the descriptors of a worker that has ended."""
        self.connection.close()
        self.output.close()


# ---------------------------------------------------------------------------------------------------------- the pool


class Pool:
    """Workers that share groups of items: a context manager that ends all its processes on exit.

    ``make(argument)`` builds the handler in each worker, with the plugins in ``folders`` available.
    ``limits`` has the seconds that an item may take, and the bytes of memory that it may use, libraries included. With
    ``single_thread``, numerical libraries use one thread. ``outside(item)`` are the modules from outside whose code an
    item runs, the same for all items of a group: a worker that has run such code only runs items with the same ones.
    """

    def __init__(
        self,
        n_workers: int,
        make: Callable[[Any], Handler],
        argument: Any,
        limits: Execution,
        single_thread: bool = True,
        folders: Sequence[Path] = (),
        outside: Callable[[Any], frozenset[str]] = lambda _: frozenset(),
    ) -> None:
        self._n_workers, self._limits, self._single_thread = n_workers, limits, single_thread
        self._first_message = pickle.dumps((tuple(folders), make, pickle.dumps(argument)))
        self._outside = outside
        self._workers: list[_Worker] = []
        self._retries: deque[deque[Any]] = deque()
        self._crashed: set[int] = set()
        self._n_failed_starts = 0
        self._reaper: Reaper | None = None

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        while self._workers:
            self._remove(self._workers[-1])
        if self._reaper is not None:
            self._reaper.close()
            self._reaper = None

    def run(self, groups: Sequence[Sequence[Any]]) -> Iterator[list[TaskResult]]:
        """Yield answers as they arrive, one per item, and an empty list if none arrive within :data:`BATCH_S`.

        The items of a group go to one worker, in order, unless another worker is idle.
        """
        waiting = deque(deque(group) for group in groups if group)
        while True:
            until = time.monotonic() + BATCH_S
            answers = self._assign(waiting)
            busy = self._busy
            while busy and (left := until - time.monotonic()) > 0:
                wait([worker.connection for worker in busy], left)
                answers += [answer for worker in busy for answer in self._collect(worker, waiting)]
                answers += self._assign(waiting)
                busy = self._busy
            if not busy and not answers:
                return
            yield answers

    @property
    def _busy(self) -> list[_Worker]:
        return [worker for worker in self._workers if worker.item is not None or worker.queue]

    @property
    def current(self) -> list[Any]:
        """The items being worked on."""
        return [worker.item for worker in self._workers if worker.item is not None]

    def _assign(self, waiting: deque[deque[Any]]) -> list[TaskResult]:
        """Assign work to every idle worker, and start more workers while groups are waiting; returns failures to send."""
        for worker in [worker for worker in self._workers if not worker.queue and worker.item is None]:
            place = next((i for i, group in enumerate(waiting) if self._may_run(worker, group)), None)
            if place is not None:
                worker.queue = waiting[place]
                del waiting[place]
            elif waiting:  # a new worker runs them
                self._remove(worker)
            else:
                worker.queue = self._take_half(worker)
        # an earlier item may have caused the death of a worker, so the item it died on is retried in a new worker
        for groups in (self._retries, waiting):
            while groups and len(self._workers) < self._n_workers:
                worker = self._start_worker()
                worker.queue = groups.popleft()
                self._workers.append(worker)
        answers: list[TaskResult] = []
        for worker in self._workers:
            while worker.queue and worker.is_ready and worker.item is None:
                worker.outside = worker.outside or self._outside(worker.queue[0])
                if (answer := worker.send_next()) is not None:
                    answers.append(answer)
        return answers

    def _may_run(self, worker: _Worker, group: Sequence[Any]) -> bool:
        return not worker.outside or worker.outside == self._outside(group[0])

    def _take_half(self, idle: _Worker) -> deque[Any]:
        """Remove and return the second half of the slowest queue; empty if that queue takes less than 5 s: it compiles again."""
        longest = max(self._workers, key=lambda worker: len(worker.queue) * worker.pace)
        half: deque[Any] = deque()
        if longest.queue and not self._may_run(idle, longest.queue):
            return half
        if len(longest.queue) * longest.pace > 5.0:
            for _ in range(len(longest.queue) // 2):
                half.appendleft(longest.queue.pop())
        return half

    def _start_worker(self) -> _Worker:
        if self._reaper is None:
            self._reaper = Reaper()
        ours, theirs = socket.socketpair()
        # a worker that has sent half a message, or reads none, is not waited for
        for option in (socket.SO_RCVTIMEO, socket.SO_SNDTIMEO):
            ours.setsockopt(socket.SOL_SOCKET, option, struct.pack("@ll", int(EXIT_S), 0))
        output, mark = guard.temporary_file(), f"{self._reaper.mark}{uuid.uuid4().hex}"
        process = subprocess.Popen(
            command(theirs.fileno()),
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
            env=registry.environment() | {MARK: mark} | dict.fromkeys(THREADS if self._single_thread else (), "1"),
        )
        # a socket reports its end only when every copy of the other side is closed, including this copy
        theirs.close()
        worker = _Worker(process, Connection(ours.detach()), output, psutil.Process(process.pid), mark)
        worker.send(self._first_message)  # short enough to be sent before the worker reads
        return worker

    def _collect(self, worker: _Worker, waiting: deque[deque[Any]]) -> list[TaskResult]:
        """Return a worker's new answers. A worker that has died or exceeds a limit is removed and its items reassigned."""
        answers = worker.receive()
        end = self._check(worker)
        if end is None:
            return answers
        kind, reason = end
        was_killed = kind == "stopped" or (worker.process.returncode or 0) < 0
        worker.kill()
        if kind != "done":
            answers += worker.receive()  # answers sent before it died still count
        output = worker.take_output()
        self._remove(worker)
        self._n_failed_starts = 0 if worker.is_ready else self._n_failed_starts + 1
        # the run ends with an error after three workers in a row were killed during their start
        if not worker.is_ready and (self._n_failed_starts == 3 or not was_killed):
            raise UserError(f"a worker cannot start: {reason}; last output: {output or 'none'}")
        rest = worker.queue  # the items behind the failed item have not run
        if worker.item is not None and kind != "done":
            item, seconds = worker.item, time.monotonic() - worker.since
            # an earlier item or another program may have killed the worker, and earlier items may have used the memory
            if id(item) not in self._crashed and kind != "timeout" and (kind != "memory" or worker.n_answered):
                self._crashed.add(id(item))
                self._retries.append(deque([item, *rest]))
                return answers
            twice = ", in two workers" if id(item) in self._crashed else ""
            status = "timeout" if kind == "timeout" else "crashed"
            answers.append(TaskResult(item, {"status": status, "reason": reason + twice}, seconds, output))
        if rest:
            waiting.appendleft(rest)
        return answers

    def _remove(self, worker: _Worker) -> None:
        worker.kill()
        worker.close()
        self._workers.remove(worker)

    def _check(self, worker: _Worker) -> tuple[Literal["crashed", "stopped", "timeout", "memory", "done"], str] | None:
        """Return why a worker has to be replaced, as a kind and a reason; None if it can continue."""
        if worker.is_done:
            return "done", "a plugin has changed its process"
        now = time.monotonic()
        # the items' time and memory are checked 20 times a second
        if not worker.fault and now < worker.checked + 0.05:
            return None
        worker.checked, code = now, worker.process.poll()
        if code is None and worker.fault == LOST:
            with suppress(subprocess.TimeoutExpired):
                code = worker.process.wait(EXIT_S)
        if code is not None:
            return "crashed", describe_exit(code)
        if worker.fault:
            return "crashed", worker.fault
        if os.fstat(worker.output.fileno()).st_size > MOST_OUTPUT:
            os.ftruncate(worker.output.fileno(), 0)
        timeout, memory = self._limits.timeout, self._limits.memory
        # starting a worker and importing an item's libraries may take 60 s beyond the item's time limit
        if timeout is not None and now - worker.since > timeout + (0 if worker.is_prepared else 60.0):
            return "timeout", f"no result within {timeout:g} s"
        with suppress(psutil.Error):
            if memory is not None and worker.resident_bytes() > memory:
                return "memory", f"stopped for using more than {memory / 2**30:.3g} GiB of memory"
            if worker.usage.status() == psutil.STATUS_STOPPED:
                return "stopped", "stopped by a signal"
        return None
