"""Runs items in worker processes, one item at a time, with limits on the time and memory of each item.

A worker is a process in its own session. It builds a handler once and then handles items as they arrive, so that imports
and compilations happen once. It answers in JSON, and its printed output arrives through a separate pipe: nothing that a
worker sends is executed here. (Pools of the standard library lose all their items when one worker dies.)
"""

from __future__ import annotations

import json
import math
import os
import pickle
import select
import signal
import socket
import subprocess
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import psutil

from bench.errors import STATUSES, StorageError, UserError, failure
from bench.run.reaper import MARK, Reaper, kill_marked_processes
from bench.run.worker import END_OF_OUTPUT, Channel, ConnectionLost, Handler, MalformedMessage, command, first_message

TICK = 0.05
"""Seconds between checks of the items' time and memory."""
CHILDREN_S = 1.0
"""Seconds between searches for the processes that a worker has started, whose memory counts as the worker's."""
AHEAD_S = 0.05
"""Seconds of work sent to a worker in advance, so that it does not wait while results are written."""
MAX_AHEAD = 16
"""Largest number of items sent to a worker in advance."""
MAX_UNSENT = 1 << 16
"""Unsent bytes for a worker above which no items are sent in advance."""
STEAL_S = 5.0
"""Seconds of queued work above which an idle worker takes half of a queue, although it has to compile again."""
START_S = 60.0
"""Seconds allowed for starting a worker and importing an item's libraries, in addition to the item's time limit."""
TAIL = 16000
"""Bytes stored of the end of a worker's printed output."""
EXIT_S = 5.0
"""Seconds allowed for a process to end after it has closed its connection."""
MAX_FAILED_STARTS = 3
"""Number of consecutive workers killed during their start after which the run ends with an error."""
SINGLE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NPROC": "1",
}
"""Environment variables that limit numerical libraries to one thread, if set before the libraries are imported."""


@dataclass(frozen=True)
class ResourceLimits:
    """Limits of one item; None for no limit."""

    timeout: float | None = None
    """Seconds."""
    memory: int | None = None
    """Bytes of resident memory, libraries included."""


@dataclass(frozen=True)
class Answer:
    """The result of an item, or the reason why it has none."""

    item: Any
    result: dict[str, Any]
    """The handler's result; ``status`` and ``reason`` if the worker was killed or died."""
    seconds: float
    output: str = ""
    """The last lines printed while the item was handled."""
    machine: str = ""
    """Kind of the machine that handled the item; empty for this machine."""


# ---------------------------------------------------------------------------------------------------------- a worker


@dataclass(eq=False)
class _Worker:
    process: subprocess.Popen[bytes]
    channel: Channel
    output: int
    """Descriptor for reading the worker's printed output."""
    usage: psutil.Process
    mark: str
    queue: deque[Any] = field(default_factory=deque)
    """Items to send to the worker."""
    sent: deque[Any] = field(default_factory=deque)
    """Items sent to the worker and not answered; it works on the first."""
    since: float = field(default_factory=time.monotonic)
    """Monotonic time in seconds at which the first item was sent or, once its imports are done, was started."""
    is_ready: bool = False
    """Whether it has built its handler."""
    is_prepared: bool = False
    """Whether it has imported the libraries of the current item, so that the item's own time has begun."""
    children: list[psutil.Process] = field(default_factory=list)
    """The processes that it had started when they were last searched for."""
    children_since: float = 0.0
    """Monotonic time in seconds of that search."""
    pace: float = 1.0
    """Seconds that the last item took."""
    printed: bytes = b""
    n_answered: int = 0
    is_done: bool = False
    """Whether it handles no more items, since a plugin has changed its process."""
    fault: ConnectionLost | MalformedMessage | None = None
    """Fault that ended the connection to the worker."""

    def resident_bytes(self) -> int:
        """Return the resident memory of the worker and of the processes that it has started, such as engines."""
        now = time.monotonic()
        if now > self.children_since + CHILDREN_S:
            # a search through all processes, so not at each check
            self.children, self.children_since = self.usage.children(recursive=True), now
        total = int(self.usage.memory_info().rss)
        for child in self.children:
            with suppress(psutil.Error):
                total += int(child.memory_info().rss)
        return total

    @property
    def capacity(self) -> int:
        """Number of items that may be sent to the worker now."""
        if self.sent and self.channel.n_unsent > MAX_UNSENT:
            return 0
        return 1 + min(MAX_AHEAD, int(AHEAD_S / max(self.pace, 1e-6))) - len(self.sent)

    def send_next(self) -> Answer | None:
        """Send the next item of the queue; returns an answer with the failure if the item cannot be pickled."""
        item = self.queue.popleft()
        try:
            message = pickle.dumps(item)
        except Exception as error:
            return Answer(item, dict(failure(error)), 0.0)
        if not self.sent:
            self.since, self.is_prepared = time.monotonic(), False
        self.sent.append(item)
        with suppress(ConnectionLost):  # the next check of the worker reports its end
            self.channel.send(message)
        return None

    def read_output(self) -> None:
        """Read the worker's new output, and store the last :data:`TAIL` bytes of all its output."""
        with suppress(OSError):
            while chunk := os.read(self.output, 1 << 16):
                self.printed = (self.printed + chunk)[-TAIL:]
                if len(chunk) < 1 << 16:
                    return

    def take_output(self) -> str:
        """Return the last lines printed since the last call, or the first lines of Python's crash dump, joined by ``|``."""
        output, end, rest = self.printed.partition(END_OF_OUTPUT)
        self.printed = rest if end else b""
        _, crash, dump = output.decode(errors="replace").rpartition("(most recent call first):")
        printable = ("".join(c for c in line if c.isprintable()).strip() for line in dump.split("\n"))
        lines = [line for line in printable if line]
        return " | ".join(lines[:3] if crash else lines[-4:])[-600:]

    def receive(self) -> list[Answer]:
        """Return the answers that have arrived. A fault of the connection or of a message is stored in ``fault``."""
        answers: list[Answer] = []
        try:
            while self.fault is None and self.sent and (messages := self.channel.receive()):
                for message in messages:
                    answers += self._read(message)
        except (ConnectionLost, MalformedMessage) as error:
            self.fault = error
        self.read_output()
        return answers

    def _read(self, message: bytes) -> list[Answer]:
        """Return the answers in a message, one or none; raises :class:`MalformedMessage` and :class:`StorageError`."""
        try:
            content = json.loads(message)
            match content["event"]:
                case "ready":
                    self.is_ready = True
                    return []
                case "started":
                    self.since, self.is_prepared = time.monotonic(), True
                    return []
                case "storage":
                    raise StorageError(content["reason"])
                case "answer":
                    result, seconds = _result_in(content)
                    item = self.sent.popleft()
                case _:
                    raise MalformedMessage
        except (ValueError, LookupError, TypeError, RecursionError) as error:
            raise MalformedMessage from error
        self.read_output()
        answer = Answer(item, result, seconds, self.take_output() if END_OF_OUTPUT in self.printed else "")
        self.is_done = content.get("is_last") is True
        self.pace, self.since, self.is_prepared = seconds, time.monotonic(), False
        self.n_answered += 1
        return [answer]

    def kill(self) -> None:
        """Kill the worker and all processes that it has started."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.kill()
        self.process.wait()
        kill_marked_processes(self.mark)
        self.read_output()

    def close(self) -> None:
        """Close the descriptors of a worker that has ended."""
        self.channel.close()
        with suppress(OSError):
            os.close(self.output)


# ---------------------------------------------------------------------------------------------------------- the pool


class Pool:
    """Workers that share groups of items: a context manager that ends all its processes on exit.

    ``make(argument)`` builds the handler in each worker, with the plugins in ``folders`` available. With
    ``single_thread``, numerical libraries use one thread.
    """

    def __init__(
        self,
        n_workers: int,
        make: Callable[[Any], Handler],
        argument: Any,
        limits: ResourceLimits,
        single_thread: bool = True,
        folders: Sequence[Path] = (),
    ) -> None:
        self._n_workers, self._limits, self._single_thread = n_workers, limits, single_thread
        self._first_message = first_message(make, pickle.dumps(argument), tuple(folders))
        self._workers: list[_Worker] = []
        self._unpicklable: list[Answer] = []
        self._retries: deque[deque[Any]] = deque()
        self._crashed: set[int] = set()
        self._n_failed_starts = 0
        self._mark = uuid.uuid4().hex
        self._reaper: Reaper | None = None

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        while self._workers:
            worker = self._workers.pop()
            worker.kill()
            worker.close()
        if self._reaper is not None:
            self._reaper.close()
            self._reaper = None

    def run(self, groups: Sequence[Sequence[Any]]) -> Iterator[list[Answer]]:
        """Yield answers as they arrive, one per item, and an empty list if none arrive within :data:`TICK`.

        The items of a group go to one worker, in order, unless another worker is idle.
        """
        waiting = deque(deque(group) for group in groups if group)
        while True:
            self._assign(waiting)
            busy = [worker for worker in self._workers if worker.sent]
            if not busy and not self._unpicklable:
                return
            _wait(busy, 0 if self._unpicklable else TICK)
            answers, self._unpicklable = self._unpicklable, []
            yield answers + [answer for worker in busy for answer in self._collect(worker, waiting)]

    @property
    def current(self) -> list[Any]:
        """The items being worked on."""
        return [worker.sent[0] for worker in self._workers if worker.sent]

    def _assign(self, waiting: deque[deque[Any]]) -> None:
        """Assign work to every idle worker, and start more workers while groups are waiting."""
        for worker in self._workers:
            if not worker.queue and not worker.sent:
                worker.queue = waiting.popleft() if waiting else self._take_half()
        # an earlier item may have caused the death of a worker, so the item it died on is retried in a new worker
        for groups in (self._retries, waiting):
            while groups and len(self._workers) < self._n_workers:
                worker = self._start_worker()
                worker.queue = groups.popleft()
                self._workers.append(worker)
        if self._reaper is not None:  # it starts while the workers do
            self._reaper.wait_until_ready()
        for worker in self._workers:
            while worker.queue and worker.capacity > 0:
                if (answer := worker.send_next()) is not None:
                    self._unpicklable.append(answer)

    def _take_half(self) -> deque[Any]:
        """Remove and return the second half of the slowest queue; empty if that queue takes less than :data:`STEAL_S`."""
        longest = max(self._workers, key=lambda worker: len(worker.queue) * worker.pace)
        half: deque[Any] = deque()
        if len(longest.queue) * longest.pace > STEAL_S:
            for _ in range(len(longest.queue) // 2):
                half.appendleft(longest.queue.pop())
        return half

    def _start_worker(self) -> _Worker:
        if self._reaper is None:
            self._reaper = Reaper(self._mark)
        ours, theirs = socket.socketpair()
        output, printed = os.pipe()
        # reading the output must never wait
        os.set_blocking(output, False)
        mark = f"{self._mark}-{uuid.uuid4().hex}"
        process = subprocess.Popen(
            command(theirs.fileno()), pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL,
            stdout=printed, stderr=printed, start_new_session=True,
            env=os.environ | {MARK: mark} | (SINGLE_THREAD if self._single_thread else {}),
        )  # fmt: skip
        # a socket reports its end only when every copy of the other side is closed, including this copy
        theirs.close()
        os.close(printed)
        worker = _Worker(process, Channel(ours), output, psutil.Process(process.pid), mark)
        with suppress(ConnectionLost):
            worker.channel.send(self._first_message)
        return worker

    def _collect(self, worker: _Worker, waiting: deque[deque[Any]]) -> list[Answer]:
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
        worker.close()
        self._workers.remove(worker)
        self._n_failed_starts = 0 if worker.is_ready else self._n_failed_starts + 1
        if not worker.is_ready and (self._n_failed_starts == MAX_FAILED_STARTS or not was_killed):
            raise UserError(f"a worker cannot start: {reason}; last output: {worker.take_output() or 'none'}")
        if worker.sent and worker.is_ready and kind != "done":
            item, seconds = worker.sent.popleft(), time.monotonic() - worker.since
            if self._may_retry(worker, item, kind):
                self._crashed.add(id(item))
                self._retries.append(deque([item, *worker.sent, *worker.queue]))
                return answers
            twice = ", in two workers" if id(item) in self._crashed else ""
            status = "timeout" if kind == "timeout" else "crashed"
            answers.append(Answer(item, {"status": status, "reason": reason + twice}, seconds, worker.take_output()))
        # the items queued behind the failed item have not run
        rest = deque([*worker.sent, *worker.queue])
        if rest:
            waiting.appendleft(rest)
        return answers

    def _may_retry(self, worker: _Worker, item: Any, kind: str) -> bool:
        """Return whether to retry an item in a new worker before the worker's death counts as the item's result.

        An earlier item or another program may have killed the worker, and earlier items may have used the memory.
        """
        if id(item) in self._crashed or kind == "timeout":
            return False
        return kind != "memory" or worker.n_answered > 0

    def _check(self, worker: _Worker) -> tuple[Literal["crashed", "stopped", "timeout", "memory", "done"], str] | None:
        """Return why a worker has to be replaced, as a kind and a reason; None if it can continue."""
        if worker.is_done:
            return "done", "a plugin has changed its process"
        code = worker.process.poll()
        if code is None and isinstance(worker.fault, ConnectionLost):
            with suppress(subprocess.TimeoutExpired):
                code = worker.process.wait(EXIT_S)
        if code is not None:
            return "crashed", describe_exit(code)
        if worker.fault is not None:
            malformed = isinstance(worker.fault, MalformedMessage)
            return "crashed", "sent a malformed message" if malformed else "closed its connection"
        if not worker.sent:
            return None
        timeout, memory = self._limits.timeout, self._limits.memory
        if timeout is not None and time.monotonic() - worker.since > timeout + (0 if worker.is_prepared else START_S):
            return "timeout", f"no result within {timeout:g} s"
        with suppress(psutil.Error):
            if memory is not None and worker.resident_bytes() > memory:
                return "memory", f"stopped for using more than {memory / 2**30:.3g} GiB of memory"
            if worker.usage.status() == psutil.STATUS_STOPPED:
                return "stopped", "stopped by a signal"
        return None


def _result_in(content: Mapping[str, Any]) -> tuple[dict[str, Any], float]:
    """Return the result in an answer and its seconds; raises ValueError, TypeError or LookupError if it is malformed."""
    result, seconds = dict(content["result"]), float(content["seconds"])
    if result["status"] not in STATUSES or not isinstance(result.get("reason", ""), str) or not 0 <= seconds < math.inf:
        raise ValueError("an answer has a status, a reason and a time")
    return result, seconds


def describe_exit(code: int) -> str:
    """Describe how a process ended, from its exit code; negative codes are signals."""
    if code >= 0:
        return f"the process ended with exit status {code}"
    name = signal.Signals(-code).name
    return f"killed by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")


def _wait(workers: Sequence[_Worker], seconds: float) -> None:
    """Wait at most ``seconds`` until a worker sends a message, prints output or accepts unsent bytes."""
    poll = select.poll()
    for worker in workers:
        poll.register(worker.channel, select.POLLIN | (select.POLLOUT if worker.channel.n_unsent else 0))
        poll.register(worker.output, select.POLLIN)
    poll.poll(1000 * seconds)
    for worker in workers:
        with suppress(ConnectionLost):
            worker.channel.flush()
        worker.read_output()
