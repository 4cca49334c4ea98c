"""Keeps a process what it is while plugins are at work in it: its working folder, its number, its children, its terminal."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator

from bench.errors import INTERRUPTED, printable

HEARD = 300
"""Letters that are told of what a plugin has printed."""


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
    raise_pending_interrupt()


def raise_pending_interrupt() -> None:
    """Raise the KeyboardInterrupt that a plugin, a callback from C or a finaliser has swallowed."""
    if INTERRUPTED.is_set():
        INTERRUPTED.clear()
        raise KeyboardInterrupt


@contextlib.contextmanager
def quiet(who: str) -> Iterator[None]:
    """Keep what a plugin prints from the terminal, raw as it is, and tell the beginning of it on one line of stderr.

    Descriptors are turned aside, not ``sys.stdout``: what libraries print goes there too, and a plugin may keep the stream.
    """
    _flush()
    with contextlib.ExitStack() as stack:
        try:
            aside = stack.enter_context(tempfile.TemporaryFile())
        except OSError:  # no place for it
            aside = stack.enter_context(open(os.devnull, "w+b"))
        for descriptor in (1, 2):
            with contextlib.suppress(OSError):  # it is closed
                kept = os.dup(descriptor)
                stack.callback(os.close, kept)
                os.dup2(aside.fileno(), descriptor)
                stack.callback(os.dup2, kept, descriptor)
        try:
            yield
        finally:
            _flush()
            said = os.pread(aside.fileno(), 4 * HEARD, 0).decode(errors="replace")
    if said.strip():
        print(f"bench: {who} printed: {printable(said)[:HEARD]}", file=sys.stderr)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # a plugin may have closed or replaced it
            stream.flush()


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
