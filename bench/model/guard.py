"""Keeps a process what it is while plugins are at work in it: its working folder, its number, its children."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

from bench.errors import INTERRUPTED


def end_copies(own: int) -> None:
    """End this process if a plugin has forked it from the one of that number, whose work it must not do again."""
    if os.getpid() != own:
        os._exit(0)


@contextlib.contextmanager
def guarded() -> Iterator[None]:
    """Keep the process what it is while a plugin is at work: in its working folder, and no forked copy of it goes on.

    An interrupt that was swallowed meanwhile is raised when it is over.
    """
    own, here = os.getpid(), _folder()
    try:
        yield
    except KeyboardInterrupt:
        INTERRUPTED.clear()
        raise
    finally:
        end_copies(own)
        if here and _folder() != here:
            os.chdir(here)
    heed_interrupts()


def heed_interrupts() -> None:
    """Raise the KeyboardInterrupt that a plugin, a callback from C or a finaliser has swallowed."""
    if INTERRUPTED.is_set():
        INTERRUPTED.clear()
        raise KeyboardInterrupt


def _folder() -> str:
    try:
        return os.getcwd()
    except FileNotFoundError:  # it has been removed
        return ""


def end_children() -> None:
    """Kill the processes that a plugin has started from this one and left running."""
    try:
        # raises without children, which spares the search through all processes
        os.waitpid(-1, os.WNOHANG)
    except ChildProcessError:
        return
    import psutil

    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            child.kill()
        with contextlib.suppress(ChildProcessError):
            os.waitpid(child.pid, 0)
