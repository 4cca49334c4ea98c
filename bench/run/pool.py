"""Runs work in processes that can be killed: one item at a time, with limits on its time and memory.

A worker is a process in a session of its own. It builds a handler once, then handles items as they come, so that imports
and compilations are paid once. It answers in JSON, and what it prints comes back through a pipe: nothing that a worker
sends is executed here. (Pools of the standard library lose all their items when one worker dies.)
"""

from __future__ import annotations

import json
import os
import pickle
import secrets
import select
import signal
import socket
import subprocess
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from bench.errors import StorageError, UserError, failure
from bench.run import worker as process
from bench.run.channel import BOUND, TOKEN, Broken, Channel
from bench.run.reaper import MARK, Guardian, kill_marked
from bench.run.worker import READY, Handler

TICK = 0.05
"""Seconds between looks at the time and memory that items take."""
AHEAD_S = 0.05
"""Seconds of work that a worker gets ahead, so that it need not wait while results are written."""
AHEAD = 16
"""Most items that a worker gets ahead."""
STEAL_S = 5.0
"""Seconds of work that a group must have left before an idle worker takes half of it and compiles again."""
START_S = 60.0
"""Seconds granted to a worker for starting, and for importing what an item needs, beyond the item's own time."""
TAIL = 16000
"""Bytes of a worker's output that are kept."""
GONE_S = 5.0
"""Seconds granted to a process for ending once it has closed its connection."""
STARTS = 3
"""Workers in a row that may be killed while they start; more is no accident."""
SINGLE = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NPROC": "1",
}
"""Settings that keep numerical libraries to one thread, if set before these are imported."""


@dataclass(frozen=True)
class ResourceLimits:
    """Limits of one item; None for no limit."""

    timeout: float | None = None
    """Seconds."""
    memory: int | None = None
    """Bytes of resident memory, libraries included."""


@dataclass(frozen=True)
class Answer:
    """The outcome of an item: its result, or why there is none."""

    item: Any
    result: dict[str, Any]
    """The handler's result; ``status`` and ``reason`` where the worker was killed or died."""
    seconds: float
    output: str = ""
    """The last lines printed while the item was handled."""
    machine: str = ""
    """The kind of machine that handled it; empty for this one."""
    stored: bool = False
    """Whether that machine has stored the row."""


# ------------------------------------------------------------------------------------------------ the pool


@dataclass(eq=False)
class _Worker:
    process: subprocess.Popen[bytes]
    channel: Channel
    output: int
    """Descriptor of what it prints."""
    facts: psutil.Process
    mark: str
    group: deque[Any] = field(default_factory=deque)
    """Items it will get next."""
    given: deque[Any] = field(default_factory=deque)
    """Items it got and has not answered; it works on the first."""
    since: float = field(default_factory=time.monotonic)
    ready: bool = False
    """Whether it has built its handler."""
    begun: bool = False
    """Whether it has imported what the current item needs."""
    pace: float = 1.0
    """Seconds the last item took."""
    tail: bytes = b""
    handled: int = 0
    """Items it has answered."""
    broken: str = ""
    """Why nothing more is expected of it."""

    @property
    def room(self) -> int:
        """How many more items it should get."""
        if self.given and self.channel.waiting > BOUND:
            return 0
        return 1 + min(AHEAD, int(AHEAD_S / max(self.pace, 1e-6))) - len(self.given)

    def listen(self) -> None:
        """Keep the end of the printed output."""
        with suppress(OSError):
            while chunk := os.read(self.output, 1 << 16):
                self.tail = (self.tail + chunk)[-TAIL:]
                if len(chunk) < 1 << 16:
                    return

    def take_output(self) -> str:
        """Return the last lines printed since the last call, or the first of Python's dump of a crash, on one line."""
        _, crash, dump = self.tail.decode(errors="replace").rpartition("(most recent call first):")
        self.tail = b""
        printable = ("".join(letter for letter in line if letter.isprintable()).strip() for line in dump.split("\n"))
        lines = [line for line in printable if line]
        return " | ".join(lines[:3] if crash else lines[-4:])[-600:]


class Pool:
    """Workers that share groups of items: a context manager that leaves no process behind.

    ``make(argument)`` builds the handler in each worker, which finds plugins in ``folders`` too. With ``single``,
    numerical libraries keep to one thread.
    """

    def __init__(
        self,
        count: int,
        make: Callable[[Any], Handler],
        argument: Any,
        limits: ResourceLimits,
        single: bool = True,
        folders: Sequence[Path] = (),
    ) -> None:
        self._count, self._make, self._limits, self._single = count, make, limits, single
        self._argument, self._folders = pickle.dumps(argument), tuple(folders)
        self._workers: list[_Worker] = []
        self._unsent: list[Answer] = []
        self._again: deque[deque[Any]] = deque()
        self._crashed: set[int] = set()
        self._unready = 0
        self._mark = uuid.uuid4().hex
        self._guardian: Guardian | None = None

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        while self._workers:
            worker = self._workers.pop()
            _end(worker)
            _close(worker)
        if self._guardian is not None:
            self._guardian.dismiss()
            self._guardian = None

    def run(self, groups: Sequence[Sequence[Any]]) -> Iterator[list[Answer]]:
        """Yield answers as they come, each item once, and an empty list now and then.

        The items of a group go to one worker, in order, while that pays.
        """
        waiting = deque(deque(group) for group in groups if group)
        while True:
            self._share(waiting)
            busy = [worker for worker in self._workers if worker.given]
            if not busy and not self._unsent:
                return
            _wait(busy, 0 if self._unsent else TICK)
            answers, self._unsent = self._unsent, []
            yield answers + [answer for worker in busy for answer in self._look_after(worker, waiting)]

    @property
    def current(self) -> list[Any]:
        """The items being worked on."""
        return [worker.given[0] for worker in self._workers if worker.given]

    def _share(self, waiting: deque[deque[Any]]) -> None:
        """Give every worker something to do, and start more workers while items are waiting."""
        for worker in self._workers:
            if not worker.group and not worker.given:
                worker.group = waiting.popleft() if waiting else self._half()
        # what a worker died of may be what it did before: the item at work then gets a worker of its own
        for groups in (self._again, waiting):
            while groups and len(self._workers) < self._count:
                worker = self._start()
                worker.group = groups.popleft()
                self._workers.append(worker)
        for worker in self._workers:
            while worker.group and worker.room > 0:
                self._give(worker)

    def _half(self) -> deque[Any]:
        """Take the second half of the longest group that another worker has left."""
        longest = max(self._workers, key=lambda worker: len(worker.group) * worker.pace)
        taken: deque[Any] = deque()
        if len(longest.group) * longest.pace > STEAL_S:
            for _ in range(len(longest.group) // 2):
                taken.appendleft(longest.group.pop())
        return taken

    def _give(self, worker: _Worker) -> None:
        item = worker.group.popleft()
        try:
            message = pickle.dumps(item)
        except Exception as error:
            self._unsent.append(Answer(item, dict(failure(error)), 0.0))
            return
        if not worker.given:
            worker.since, worker.begun = time.monotonic(), False
        worker.given.append(item)
        with suppress(Broken):  # _look_after finds a worker that has died
            worker.channel.send(message)

    def _start(self) -> _Worker:
        if self._guardian is None:
            self._guardian = Guardian(self._mark)
        ours, theirs = socket.socketpair()
        output, printed = os.pipe()
        # listen() reads what there is and never waits
        os.set_blocking(output, False)
        token, mark = secrets.token_bytes(TOKEN), f"{self._mark}-{uuid.uuid4().hex}"
        started = subprocess.Popen(
            process.command(theirs.fileno(), token), pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL,
            stdout=printed, stderr=printed, start_new_session=True,
            env=os.environ | {MARK: mark} | (SINGLE if self._single else {}),
        )  # fmt: skip
        # a socket reports its end only when every copy of the other side is closed, this one too
        theirs.close()
        os.close(printed)
        worker = _Worker(started, Channel(ours, token), output, psutil.Process(started.pid), mark)
        with suppress(Broken):
            worker.channel.send(process.first(self._make, self._argument, self._folders))
        return worker

    def _look_after(self, worker: _Worker, waiting: deque[deque[Any]]) -> list[Answer]:
        answers = _received(worker)
        verdict = self._verdict(worker)
        if verdict is None:
            return answers
        by_signal = verdict[0] == "stopped" or (worker.process.returncode or 0) < 0
        _end(worker)
        answers += _received(worker)  # answers sent before it died still count
        _close(worker)
        self._workers.remove(worker)
        self._unready = 0 if worker.ready else self._unready + 1
        if not worker.ready and (self._unready == STARTS or not by_signal):
            raise UserError(f"a worker cannot start: {verdict[1]}; last output: {worker.take_output() or 'none'}")
        if worker.given and worker.ready:
            guilty, seconds = worker.given.popleft(), time.monotonic() - worker.since
            if self._once_more(worker, guilty, verdict[0]):
                self._again.append(deque([guilty, *worker.given, *worker.group]))
                return answers
            twice = ", in two workers" if id(guilty) in self._crashed else ""
            status = "timeout" if verdict[0] == "timeout" else "crashed"
            result = {"status": status, "reason": verdict[1] + twice}
            answers.append(Answer(guilty, result, seconds, worker.take_output()))
        # the items behind the guilty one did nothing wrong
        left = deque([*worker.given, *worker.group])
        if left:
            waiting.appendleft(left)
        return answers

    def _once_more(self, worker: _Worker, item: Any, status: str) -> bool:
        """Return whether an item should have another worker before it is blamed.

        What the worker did before may have killed it, or someone from outside; too much memory may be that of items
        before.
        """
        if id(item) in self._crashed or status == "timeout" or (status == "memory" and not worker.handled):
            return False
        self._crashed.add(id(item))
        return True

    def _verdict(self, worker: _Worker) -> tuple[str, str] | None:
        """Return what ended a worker (``crashed``, ``stopped``, ``timeout``, ``memory``) and the reason, or None."""
        code = worker.process.poll()
        if code is None and worker.broken:
            with suppress(subprocess.TimeoutExpired):
                code = worker.process.wait(0 if "descriptors" in worker.broken else GONE_S)
        if code is not None:
            return "crashed", died(code)
        if worker.broken:
            return "crashed", worker.broken
        if not worker.given:
            return None
        timeout, memory = self._limits.timeout, self._limits.memory
        if timeout is not None and time.monotonic() - worker.since > timeout + (0 if worker.begun else START_S):
            return "timeout", f"no result within {timeout:g} s"
        with suppress(psutil.Error):
            if memory is not None and worker.facts.memory_info().rss > memory:
                return "memory", f"stopped for using more than {memory / 2**30:.3g} GiB of memory"
            if worker.facts.status() == psutil.STATUS_STOPPED:
                return "stopped", "stopped by a signal"
        return None


def died(code: int) -> str:
    """Describe what an exit code says about a process that ended by itself."""
    if code >= 0:
        return f"the process ended with exit status {code}"
    name = signal.Signals(-code).name
    return f"killed by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")


def _wait(workers: Sequence[_Worker], seconds: float) -> None:
    """Wait until a worker sends or prints something, or can take more of what waits for it."""
    poll = select.poll()
    for worker in workers:
        poll.register(worker.channel, select.POLLIN | (select.POLLOUT if worker.channel.waiting else 0))
        poll.register(worker.output, select.POLLIN)
    poll.poll(1000 * seconds)
    for worker in workers:
        with suppress(Broken):
            worker.channel.flush()
        worker.listen()


def _received(worker: _Worker) -> list[Answer]:
    answers: list[Answer] = []
    while not worker.broken and worker.given:
        try:
            messages = worker.channel.receive()
        except Broken as error:
            worker.broken = str(error)
            break
        if not messages:
            break
        for message in messages:
            answers += _answer(worker, message)
    worker.listen()
    return answers


def _answer(worker: _Worker, message: bytes) -> list[Answer]:
    if message == READY:
        worker.ready = True
        return []
    if not message:
        worker.since, worker.begun = time.monotonic(), True
        return []
    content = json.loads(message)
    if "storage" in content:
        raise StorageError(content["storage"])
    worker.listen()
    worker.pace, item = content["seconds"], worker.given.popleft()
    answer = Answer(item, content["result"], worker.pace, worker.take_output())
    worker.since, worker.begun = time.monotonic(), False
    worker.handled += 1
    return [answer]


def _end(worker: _Worker) -> None:
    """Kill a worker and everything it has started."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(worker.process.pid, signal.SIGKILL)
    worker.process.kill()
    worker.process.wait()
    kill_marked(worker.mark)
    worker.listen()


def _close(worker: _Worker) -> None:
    """Close the descriptors of a worker that has ended."""
    worker.channel.close()
    with suppress(OSError):
        os.close(worker.output)
