"""Ctrl-C while the command is still importing: it ends with a line, where Python would print the middle of an import."""

from __future__ import annotations

import os
import signal
import sys


def exit_on_interrupt() -> None:
    """Have Ctrl-C end the command at once, until it sees to signals itself; nothing where bench is a library.

    Nothing is running or half written yet. ``import bench`` in a program of someone else leaves its signals alone.
    """
    if _is_the_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _stop)


def _is_the_command() -> bool:
    words, script = sys.orig_argv, (sys.argv or [""])[0]
    if script == "-m":  # the module is being looked for, and its package imported
        return "-m" in words and words[words.index("-m") + 1] == "bench"
    return os.path.basename(script) == "diffsim-bench"


def _stop(*_: object) -> None:
    os.write(2, b"\nbench: stopped\n")
    os._exit(130)
