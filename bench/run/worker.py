"""The worker process, which builds a handler once and then handles items one by one, and its message channel."""

from __future__ import annotations

import faulthandler
import json
import os
import pickle
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from bench.errors import StorageError, failure
from bench.model import guard, isolation, registry

LENGTH = struct.Struct(">Q")
"""The length of a message in bytes, which precedes the message."""
CHUNK = 1 << 18
"""Bytes read from the socket in one call."""
MAX_MESSAGE = 1 << 30
"""Bytes of the longest valid message."""
PROGRAM = "import sys; sys.path[:] = sys.argv.pop().split(chr(0x1f)); from bench.run.worker import main; main()"
"""The program of a worker. It has the import path of its run, and does not import the run's main script."""
ENCODER = json.JSONEncoder()
"""The encoder of messages, created before a plugin can replace it."""
END_OF_OUTPUT = b"\x1ebench-end-of-output\x1e\n"
"""What a worker prints after each item, so that its output is not taken for the next item's."""


class ConnectionLost(Exception):
    """Raised when the other end of a channel is closed."""


class MalformedMessage(Exception):
    """Raised when the bytes that arrived are not a message."""


class Channel:
    """One end of a socket for messages, each preceded by its length. The worker's end is ``blocking``.

    The run's end never blocks. Bytes that do not fit into the socket are buffered here, so a worker that reads nothing
    delays neither the other workers nor the checks of time limits. Output that a plugin prints does not reach the socket.
    """

    def __init__(self, connection: socket.socket, blocking: bool = False) -> None:
        self._connection = connection
        connection.setblocking(blocking)
        self._received = bytearray()
        self._unsent = bytearray()

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._connection.fileno()

    @property
    def n_unsent(self) -> int:
        """Number of buffered bytes, to be sent."""
        return len(self._unsent)

    def send(self, message: bytes) -> None:
        """Send a message, or as much of it as fits: :meth:`flush` sends the rest."""
        self._unsent += LENGTH.pack(len(message)) + message
        self.flush()

    def flush(self) -> None:
        """Send the buffered bytes: all of them if the socket blocks, otherwise as many as fit."""
        while self._unsent:
            try:
                n_sent = self._connection.send(self._unsent)
            except BlockingIOError:
                return
            except OSError as error:
                raise ConnectionLost from error
            del self._unsent[:n_sent]

    def receive(self) -> list[bytes]:
        """Return the messages that have arrived: at least one if the socket blocks, otherwise possibly none.

        Raises :class:`ConnectionLost` or :class:`MalformedMessage` once all messages before the fault were returned.
        """
        while not (messages := self._split()):
            try:
                chunk = self._connection.recv(CHUNK)
            except BlockingIOError:
                break
            except OSError as error:
                raise ConnectionLost from error
            if not chunk:
                raise ConnectionLost
            self._received += chunk
        return messages

    def _split(self) -> list[bytes]:
        """Remove the complete messages from the received bytes and return them."""
        messages: list[bytes] = []
        while len(self._received) >= LENGTH.size:
            end = LENGTH.size + LENGTH.unpack_from(self._received)[0]
            if end > MAX_MESSAGE and not messages:
                raise MalformedMessage
            if len(self._received) < end:
                break
            messages.append(bytes(self._received[LENGTH.size : end]))
            del self._received[:end]
        return messages

    def close(self) -> None:
        """Close this end."""
        self._connection.close()


class Handler(Protocol):
    """Handles items in a worker."""

    def prepare(self, item: Any) -> None:
        """Import the libraries that the item needs; this time does not count as the item's."""

    def __call__(self, item: Any) -> dict[str, Any]:
        """Return the item's result, to be sent as JSON.

        If the attribute ``is_tainted`` is true afterwards, later items are handled in a new worker.
        """


def command(descriptor: int) -> list[str]:
    """Return the command that starts a worker connected to its run by the socket ``descriptor``."""
    return [sys.executable, "-c", PROGRAM, str(descriptor), str(os.getpid()), chr(0x1F).join(sys.path)]


def first_message(make: Callable[[Any], Handler], argument: bytes, folders: tuple[Path, ...]) -> bytes:
    """Return the first message to a worker: how to build its handler."""
    return pickle.dumps((folders, make, argument))


def main() -> None:
    """Handle items until the run closes the channel; ``sys.argv`` contains a descriptor and the run's process id."""
    descriptor, run = map(int, sys.argv[1:3])
    guard.die_with(run)  # elsewhere than on Linux see the reaper
    # Ctrl-C reaches the run, which ends its workers
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable(all_threads=False)
    sys.argv[:] = ["bench-worker"]
    with suppress(ConnectionLost):
        _serve(Channel(socket.socket(fileno=descriptor), blocking=True))


def _serve(channel: Channel) -> None:
    """Build the handler that the first message describes, then answer all later messages."""
    messages = channel.receive()
    # the argument is pickled separately, since its classes may come from the folders of plugins
    folders, make, argument = pickle.loads(messages.pop(0))
    for folder in folders:
        registry.add_folder(folder)
    pid, printed = os.getpid(), os.fstat(1)
    with isolation.undo_changes("a plugin, while it was imported,"):
        content = pickle.loads(argument)
    handle = make(content)
    channel.send(_encode("ready"))
    while True:
        messages = messages or channel.receive()
        answer = _answer(channel, handle, messages.pop(0))
        guard.exit_if_forked(pid)
        guard.kill_children()
        with suppress(Exception):
            sys.stdout.flush()
        with suppress(OSError):  # a plugin may have closed it, and opened another file under its number
            if os.path.samestat(os.fstat(1), printed):
                os.write(1, END_OF_OUTPUT)
        channel.send(answer)
        if getattr(handle, "is_tainted", False):
            return  # the run continues in a new worker


def _encode(event: str, **content: Any) -> bytes:
    """Return a message to the run as JSON; its event is ``ready``, ``started``, ``answer`` or ``storage``."""
    return ENCODER.encode({"event": event, **content}).encode()


def _answer(channel: Channel, handle: Handler, message: bytes) -> bytes:
    """Handle the item in a message and return the message that answers it."""
    pid, started = os.getpid(), time.perf_counter()
    try:
        item = pickle.loads(message)
        handle.prepare(item)
        # the imports are done, and the item's own time begins
        channel.send(_encode("started"))
        started = time.perf_counter()
        result = handle(item)
        seconds, is_last = time.perf_counter() - started, bool(getattr(handle, "is_tainted", False))
        return _encode("answer", result=result, seconds=seconds, is_last=is_last)
    except ConnectionLost:
        raise
    except StorageError as error:
        return _encode("storage", reason=str(error))
    except BaseException as error:
        guard.exit_if_forked(pid)
        return _encode("answer", result=failure(error), seconds=time.perf_counter() - started)
