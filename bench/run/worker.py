"""The worker process, which builds a handler once and then handles items one by one."""

from __future__ import annotations

import faulthandler
import json
import os
import pickle
import signal
import sys
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Protocol

from bench.errors import StorageError, failure
from bench.host import guard, reads
from bench.model import registry

PROGRAM = "import sys; sys.path[:] = sys.argv.pop().split(chr(0x1f)); from bench.run.worker import main; main()"
"""The program of a worker. It has the import path of its run, and does not import the run's main script."""
ENCODER = json.JSONEncoder()
"""The encoder of messages, created before a plugin can replace it."""


class ConnectionLost(Exception):
    """Raised when the run has ended."""


class Handler(Protocol):
    """Handles items in a worker."""

    def prepare(self, item: Any) -> None:
        """Import what the item needs; this time does not count as the item's."""

    def __call__(self, item: Any) -> dict[str, Any]:
        """Return the item's result, to be sent as JSON.

        If the attribute ``is_tainted`` is true afterwards, later items are handled in a new worker.
        """


def command(descriptor: int) -> list[str]:
    """Return the command that starts a worker connected to its run by the socket ``descriptor``."""
    return [sys.executable, "-c", PROGRAM, str(descriptor), str(os.getpid()), chr(0x1F).join(sys.path)]


def main() -> None:
    """Handle items until the run closes the channel; ``sys.argv`` contains a descriptor and the run's process id."""
    descriptor, run = map(int, sys.argv[1:3])
    os.set_inheritable(descriptor, False)
    guard.die_with(run)  # elsewhere than on Linux see the reaper
    # Ctrl-C reaches the run, which ends its workers
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable(all_threads=False)
    sys.argv[:] = ["bench-worker"]
    with suppress(ConnectionLost):
        _serve(Connection(descriptor))


def _serve(connection: Connection) -> None:
    """Build the handler that the first message describes, then answer all later messages."""
    # the argument is pickled separately, since its classes may come from the folders of plugins
    folders, make, argument = pickle.loads(_receive(connection))
    registry.restrict(frozenset())
    reads.start()
    for folder in folders:
        registry.add_folder(folder)
    pid = os.getpid()
    handle = make(pickle.loads(argument))
    _send(connection, "ready")
    while not getattr(handle, "is_tainted", False):  # the run continues in a new worker
        event, answer = _answer(connection, handle, _receive(connection))
        guard.exit_if_forked(pid)
        with suppress(Exception):  # a plugin may have closed or replaced it
            sys.stdout.flush()
        _send(connection, event, **answer)


def _receive(connection: Connection) -> bytes:
    try:
        return connection.recv_bytes()
    except (EOFError, OSError) as error:
        raise ConnectionLost from error


def _send(connection: Connection, event: str, **content: Any) -> None:
    """Send a message as JSON; its event is ``ready``, ``started``, ``answer`` or ``storage``."""
    try:
        connection.send_bytes(ENCODER.encode({"event": event, **content}).encode())
    except OSError as error:
        raise ConnectionLost from error


def _answer(connection: Connection, handle: Handler, message: bytes) -> tuple[str, dict[str, Any]]:
    """Handle the item in a message; return the event of the answer and its content."""
    pid, started = os.getpid(), time.perf_counter()
    try:
        item = pickle.loads(message)
        handle.prepare(item)
        # the imports are done, and the item's own time begins
        _send(connection, "started")
        started = time.perf_counter()
        result = handle(item)
        seconds, is_last = time.perf_counter() - started, bool(getattr(handle, "is_tainted", False))
        return "answer", {"result": result, "seconds": seconds, "is_last": is_last}
    except ConnectionLost:
        raise
    except StorageError as error:
        return "storage", {"reason": str(error)}
    except BaseException as error:
        guard.exit_if_forked(pid)
        return "answer", {"result": failure(error), "seconds": time.perf_counter() - started}
