"""The process in which items are handled: it builds a handler once, then answers one item after the other."""

from __future__ import annotations

import ctypes
import faulthandler
import json
import os
import pickle
import signal
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from bench.errors import StorageError, failure
from bench.model import guard, registry
from bench.run.channel import Broken, Channel

READY = b"ready"
"""The message of a worker that can take items."""
CODE = "import sys; sys.path[:] = sys.argv.pop().split(chr(0x1f)); from bench.run.worker import main; main()"
"""The program of a worker: it finds modules where its run does, and does not import the run's own script."""
DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of prctl(2)."""


class Handler(Protocol):
    """Handles items in a worker."""

    def prepare(self, item: Any) -> None:
        """Import what the item needs; the time is not counted as the item's."""

    def __call__(self, item: Any) -> dict[str, Any]:
        """Return the item's result, to be sent as JSON."""


def command(descriptor: int, token: bytes) -> list[str]:
    """Return the command that starts a worker with one end of a socket."""
    return [sys.executable, "-c", CODE, str(descriptor), token.hex(), str(os.getpid()), chr(0x1F).join(sys.path)]


def first(make: Any, argument: bytes, folders: tuple[Path, ...]) -> bytes:
    """Return the first message to a worker: how it builds its handler."""
    return pickle.dumps((folders, make, argument))


def main() -> None:
    """Answer items until there are none; called with descriptor, token and the run's process number as arguments."""
    descriptor, token, parent = sys.argv[1:4]
    _die_with(int(parent))
    # Ctrl-C reaches the run, which ends its workers
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable(all_threads=False)
    channel = Channel(socket.socket(fileno=int(descriptor)), bytes.fromhex(token), blocking=True)
    sys.argv[:] = ["bench-worker"]
    with suppress(Broken):
        _serve(channel)


def _die_with(parent: int) -> None:
    """Have the kernel kill this process when its run has gone, whatever it is doing (Linux; see the guardian)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)


def _serve(channel: Channel) -> None:
    """Build the handler as the first message says, then answer the others."""
    waiting = channel.receive()
    # the argument is pickled by itself, as its classes may come from folders of plugins
    folders, make, argument = pickle.loads(waiting.pop(0))
    for folder in folders:
        registry.add_folder(folder)
    own, handle = os.getpid(), make(pickle.loads(argument))
    channel.send(READY)
    while True:
        waiting = waiting or channel.receive()
        answer = _answered(channel, handle, waiting.pop(0))
        guard.exit_if_forked(own)
        guard.kill_children()
        with suppress(Exception):
            sys.stdout.flush()
        channel.send(answer)


def _answered(channel: Channel, handle: Handler, message: bytes) -> bytes:
    own, started = os.getpid(), time.perf_counter()
    try:
        item = pickle.loads(message)
        handle.prepare(item)
        # an empty message: the imports are done and the item's own time begins
        channel.send(b"")
        started = time.perf_counter()
        text = json.dumps({"result": handle(item), "seconds": time.perf_counter() - started})
    except Broken:
        raise
    except StorageError as error:
        text = json.dumps({"storage": str(error)})
    except BaseException as error:
        guard.exit_if_forked(own)
        text = json.dumps({"result": failure(error), "seconds": time.perf_counter() - started})
    return text.encode()
