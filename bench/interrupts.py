"""Ends the command with a one-line message if Ctrl-C is pressed, or memory runs out, during imports."""

from __future__ import annotations

import os
import resource
import signal
import sys
from types import TracebackType

LEAST_BYTES = 576 << 20
"""Address space below which the C library may end the process during the imports, with a message of its own."""


def exit_on_interrupt() -> None:
    """Make Ctrl-C end the command immediately, until the command installs its own signal handlers.

    This is safe: no run is active and no file is half written during imports. The signal handlers of a program that
    imports ``bench`` as a library remain unchanged.
    """
    if not _is_command():
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if 0 <= limit < LEAST_BYTES:
        _show(MemoryError, MemoryError(), None)
        os._exit(1)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _exit)
    sys.excepthook = _show


def out_of_memory(error: BaseException) -> str:
    """Return a message if an error means that the process may not have the memory it needs; else an empty string."""
    if not isinstance(error, MemoryError) and "failed to map segment" not in str(error):
        return ""
    return "bench: not enough memory: give the process more (ulimit -v limits its address space; 4 GB suffice for most runs)"


def _show(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if message := out_of_memory(error):
        os.write(2, f"{message}\n".encode())
    else:
        sys.__excepthook__(kind, error, trace)


def _is_command() -> bool:
    words, script = sys.orig_argv, (sys.argv or [""])[0]
    if script == "-m":  # Python is still importing the package of the module
        return "-m" in words and words[words.index("-m") + 1] == "bench"
    return os.path.basename(script) == "diffsim-bench"


def _exit(*_: object) -> None:
    os.write(2, b"\nbench: stopped\n")
    os._exit(130)
