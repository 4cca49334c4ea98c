"""Ends the command with a one-line message if Ctrl-C is pressed during imports."""

from __future__ import annotations

import os
import signal
import sys


def exit_on_interrupt() -> None:
    """Make Ctrl-C end the command immediately, until the command installs its own signal handlers.

    This is safe: no run is active and no file is half written during imports. The signal handlers of a program that
    imports ``bench`` as a library remain unchanged.
    """
    if _is_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _exit)


def _is_command() -> bool:
    words, script = sys.orig_argv, (sys.argv or [""])[0]
    if script == "-m":  # Python is still importing the package of the module
        return "-m" in words and words[words.index("-m") + 1] == "bench"
    return os.path.basename(script) == "diffsim-bench"


def _exit(*_: object) -> None:
    os.write(2, b"\nbench: stopped\n")
    os._exit(130)
