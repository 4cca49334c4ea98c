"""Runs work in processes that can be killed: one item at a time, with limits on its time and memory.

A worker is a spawned process in a session of its own. It builds a handler once, then handles items as they come, so
that imports and compilations are paid once. It answers in JSON, and what it prints comes back through a pipe: nothing
that a worker sends is executed here. (Pools of the standard library lose all their items when one worker dies.)
"""

from __future__ import annotations

import faulthandler
import json
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Protocol

import psutil

from bench.errors import StorageError, UserError, failure
from bench.model import registry

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
READY = b"ready"
"""The message of a worker that can take items."""
MARK = "BENCH_WORKER"
"""Environment variable that marks all processes started by a worker, wherever they have gone."""
SINGLE = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NPROC": "1",
}
"""Settings that keep numerical libraries to one thread, if set before these are imported."""


class Handler(Protocol):
    """Handles items in a worker."""

    def prepare(self, item: Any) -> None:
        """Import what the item needs; the time is not counted as the item's."""

    def __call__(self, item: Any) -> dict[str, Any]:
        """Return the item's result, to be sent as JSON."""


@dataclass(frozen=True)
class Limits:
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


# ------------------------------------------------------------------------------------------------ in a worker


def _serve(
    connection: Connection, output: Connection, make: Callable[[Any], Handler], argument: bytes, folders: Sequence[Path]
) -> None:
    """Answer items until there are none; ``argument`` is pickled, as its classes may come from plugin ``folders``."""
    # a process group of its own, so that all it starts can be killed with it
    os.setsid()
    # Ctrl-C reaches the parent, which ends its workers
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(output.fileno(), 1)
    os.dup2(output.fileno(), 2)
    faulthandler.enable(all_threads=False)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    for folder in folders:
        registry.add_folder(folder)
    own, handle = os.getpid(), make(pickle.loads(argument))
    connection.send_bytes(READY)
    while True:
        try:
            message = connection.recv_bytes()
        except EOFError:
            return
        answer = _answered(connection, handle, message)
        if os.getpid() != own:
            os._exit(0)  # a child that a plugin forked, which must not answer for its parent
        _end_children()
        with suppress(Exception):
            sys.stdout.flush()
        connection.send_bytes(answer)


def _answered(connection: Connection, handle: Handler, message: bytes) -> bytes:
    own, started = os.getpid(), time.perf_counter()
    try:
        item = pickle.loads(message)
        handle.prepare(item)
        # an empty message: the imports are done and the item's own time begins
        connection.send_bytes(b"")
        started = time.perf_counter()
        text = json.dumps({"result": handle(item), "seconds": time.perf_counter() - started})
    except StorageError as error:
        text = json.dumps({"storage": str(error)})
    except BaseException as error:
        if os.getpid() != own:
            os._exit(0)
        text = json.dumps({"result": failure(error), "seconds": time.perf_counter() - started})
    return text.encode()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    _kill(_marked(os.environ[MARK]))
    os.killpg(0, signal.SIGKILL)


def _end_children() -> None:
    """Kill the processes that a plugin has started and left running."""
    try:
        # raises without children, which spares the search through all processes
        os.waitpid(-1, os.WNOHANG)
    except ChildProcessError:
        return
    children = psutil.Process().children(recursive=True)
    _kill(children)
    for child in children:
        with suppress(ChildProcessError):
            os.waitpid(child.pid, 0)


def _marked(mark: str) -> list[psutil.Process]:
    """Return the other processes that have this mark in their environment."""
    processes = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if process.pid != os.getpid() and process.environ().get(MARK) == mark:
                processes.append(process)
    return processes


def _kill(processes: Sequence[psutil.Process]) -> None:
    for process in processes:
        with suppress(psutil.Error):
            process.kill()


# ------------------------------------------------------------------------------------------------ the pool


@dataclass(eq=False)
class _Worker:
    process: BaseProcess
    connection: Connection
    output: Connection
    memory: psutil.Process
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

    @property
    def room(self) -> int:
        """How many more items it should get."""
        return 1 + min(AHEAD, int(AHEAD_S / max(self.pace, 1e-6))) - len(self.given)

    def listen(self) -> None:
        """Keep the end of the printed output."""
        with suppress(OSError):
            while chunk := os.read(self.output.fileno(), 1 << 16):
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
        limits: Limits,
        single: bool = True,
        folders: Sequence[Path] = (),
    ) -> None:
        self._count, self._make, self._limits, self._single = count, make, limits, single
        self._argument, self._folders = pickle.dumps(argument), tuple(folders)
        self._workers: list[_Worker] = []
        self._unsent: list[Answer] = []
        self._context = multiprocessing.get_context("spawn")

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        while self._workers:
            _end(self._workers.pop())

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
            wait([end for worker in busy for end in (worker.connection, worker.output)], 0 if self._unsent else TICK)
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
        while waiting and len(self._workers) < self._count:
            worker = self._start()
            worker.group = waiting.popleft()
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
        with suppress(OSError):  # _look_after finds a worker that has died
            worker.connection.send_bytes(message)

    def _start(self) -> _Worker:
        connection, theirs = self._context.Pipe()
        output, printed = self._context.Pipe(duplex=False)
        # listen() reads what there is and never waits
        os.set_blocking(output.fileno(), False)
        process = self._context.Process(
            target=_serve, args=(theirs, printed, self._make, self._argument, self._folders)
        )
        resource_tracker.ensure_running()  # otherwise it would start with the worker's mark and be killed with it
        mark = uuid.uuid4().hex
        with _environment({MARK: mark} | (SINGLE if self._single else {})):
            process.start()
        # a pipe reports its end only when every copy of the other side is closed, this one too
        theirs.close()
        printed.close()
        return _Worker(process, connection, output, psutil.Process(process.pid), mark)

    def _look_after(self, worker: _Worker, waiting: deque[deque[Any]]) -> list[Answer]:
        answers = _received(worker)
        verdict = self._verdict(worker)
        if verdict is None:
            return answers
        _end(worker)
        answers += _received(worker)  # answers sent before it died still count
        self._workers.remove(worker)
        if not worker.ready:
            raise UserError(f"a worker cannot start: {verdict[1]}; last output: {worker.take_output() or 'none'}")
        if worker.given:
            guilty, seconds = worker.given.popleft(), time.monotonic() - worker.since
            result = {"status": verdict[0], "reason": verdict[1]}
            answers.append(Answer(guilty, result, seconds, worker.take_output()))
        # the items behind the guilty one did nothing wrong
        left = deque([*worker.given, *worker.group])
        if left:
            waiting.appendleft(left)
        return answers

    def _verdict(self, worker: _Worker) -> tuple[str, str] | None:
        """Return status and reason if a worker has to be given up, or None."""
        code = worker.process.exitcode
        if code is not None:
            return "crashed", died(code)
        if not worker.given:
            return None
        timeout, memory = self._limits.timeout, self._limits.memory
        if timeout is not None and time.monotonic() - worker.since > timeout + (0 if worker.begun else START_S):
            return "timeout", f"no result within {timeout:g} s"
        if memory is not None:
            with suppress(psutil.Error):
                if worker.memory.memory_info().rss > memory:
                    return "crashed", f"stopped for using more than {memory / 2**30:.3g} GiB of memory"
        return None


def died(code: int) -> str:
    """Describe what an exit code says about a process that ended by itself."""
    if code >= 0:
        return f"the process ended with exit status {code}"
    name = signal.Signals(-code).name
    return f"killed by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")


def _received(worker: _Worker) -> list[Answer]:
    answers: list[Answer] = []
    with suppress(EOFError, OSError):
        while worker.given and worker.connection.poll():
            message = worker.connection.recv_bytes()
            if message == READY:
                worker.ready = True
                continue
            if not message:
                worker.since, worker.begun = time.monotonic(), True
                continue
            content = json.loads(message)
            if "storage" in content:
                raise StorageError(content["storage"])
            worker.listen()
            worker.pace, item = content["seconds"], worker.given.popleft()
            answers.append(Answer(item, content["result"], worker.pace, worker.take_output()))
            worker.since, worker.begun = time.monotonic(), False
    worker.listen()
    return answers


def _end(worker: _Worker) -> None:
    """Kill a worker and everything it has started."""
    with suppress(ProcessLookupError):
        os.killpg(worker.memory.pid, signal.SIGKILL)
    worker.process.kill()
    worker.process.join()
    _kill(_marked(worker.mark))
    worker.listen()


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables for processes started meanwhile."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
