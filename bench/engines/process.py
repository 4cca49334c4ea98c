"""Starts engines in their own Python, one process per Python and engine, and calls their models over pipes.

A call depends on its arguments only. If an engine's process ends during a call, the call is repeated once in a new
process. Engines end with this process, however it ends.
"""

from __future__ import annotations

import atexit
import contextlib
import itertools
import os
import signal
import subprocess
import tempfile
import threading
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import numpy as np

from bench.engines import server
from bench.errors import Crashed, Unavailable, Unsupported, printable

TAIL = 2000
"""Bytes of an engine's last output that a message quotes."""
CLOSED = (EOFError, OSError)
"""Raised when an engine's process has ended."""

_running: dict[tuple[str, str], EngineProcess] = {}
_keys = itertools.count()
_lock = threading.Lock()


class EngineProcess:
    """The process of an engine's file in the Python ``python``. Output that it prints goes to a temporary file.

    It ends when its input, which this process holds open, is closed.
    """

    def __init__(self, python: str, file: Path) -> None:
        self._output = tempfile.TemporaryFile()  # noqa: SIM115, it is closed with the process
        self.connection, theirs = Pipe()
        words, place = [python, "-I", server.__file__, str(file), str(theirs.fileno())], theirs.fileno()
        try:
            self.process = subprocess.Popen(
                words, pass_fds=[place], stdin=subprocess.PIPE, stdout=self._output, stderr=self._output
            )
        except OSError as error:
            raise Unavailable(f"python={python} cannot be started: {error.strerror}") from error
        finally:
            theirs.close()

    def end(self) -> str:
        """End the process, if it has not ended, and return how it ended, with its last output."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            # seconds allowed for an engine to end after it has closed its connection
            self.process.wait(5.0)
        code = self.process.poll() or 0
        text = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"
        size = self._output.seek(0, os.SEEK_END)
        output = printable(os.pread(self._output.fileno(), TAIL, max(0, size - TAIL)).decode(errors="replace"))
        self.kill()
        return f"{text}; its last output: {output[-500:] or 'none'}"

    def kill(self) -> None:
        """Kill the process and close its connection."""
        self.process.kill()
        self.process.communicate()
        self.connection.close()
        self._output.close()


class EngineModel:
    """A program's model in an engine, built when it is first called and again in a new process."""

    def __init__(self, name: str, python: str, file: Path, description: dict[str, Any]) -> None:
        self._name, self._python, self._file, self._description = name, python, file, description
        self._key = next(_keys)
        self.device = "cpu"
        self.settings: dict[str, str] = {}
        """The engine's settings that can change its last digits, by name."""
        self.build_s = 0.0
        """Seconds of the last start of the engine, with its imports, and of building the model."""

    def call(self, name: str, *arrays: np.ndarray) -> tuple[dict[str, Any], list[np.ndarray]]:
        """Return the answer to ``step``, ``rollout`` or ``jacobians``, and its arrays.

        The answer has the engine's ``seconds``, the ``width`` of its batches, ``peak_memory_mb``, and ``is_first``: whether
        it was the model's first call of this kind and width, which may have compiled. Raises :class:`Crashed` if the
        engine's process ends during the call, also in a second process.
        """
        with _lock:
            for _ in range(2):
                try:
                    return self._call(name, arrays)
                except CLOSED:
                    process = _running.pop(self._place, None)
                    reason = process.end() if process is not None else "it did not start"
            raise Crashed(f"the process of engine {self._name} ended twice during {name}: {reason}")

    def _call(self, name: str, arrays: tuple[np.ndarray, ...]) -> tuple[dict[str, Any], list[np.ndarray]]:
        if self._place not in _running:
            _running[self._place] = EngineProcess(self._python, self._file)
        connection = _running[self._place].connection
        connection.send(({"call": name, "model": self._key, "description": self._description}, arrays))
        answer, results = connection.recv()
        if "error" in answer:
            error = {"unsupported": Unsupported, "unavailable": Unavailable}.get(answer["kind"], EngineError)
            raise error(f"engine {self._name}: {printable(answer['error'])} ({answer['places']})")
        self.device, self.settings, self.build_s = (answer[key] for key in ("device", "settings", "build_s"))
        return answer, results

    @property
    def _place(self) -> tuple[str, str]:
        return self._python, str(self._file)


class EngineError(Exception):
    """Raised for an exception in an engine's file; the message has its type, text and last lines."""


def close_engines() -> None:
    """End all engines of this process."""
    while _running:
        _running.popitem()[1].kill()


atexit.register(close_engines)
os.register_at_fork(after_in_child=_running.clear)  # a forked process starts engines of its own
