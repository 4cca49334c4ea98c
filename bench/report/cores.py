"""Does several pieces of work on several cores, in forked copies of this process that share what it has read."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

MOST = 255
"""Pieces that can be shared out: each is a byte in a pipe."""
UNSAFE = ("jaxlib", "torch._C")
"""Modules whose threads do not survive in a copy."""
T = TypeVar("T")


def spread(works: Sequence[Callable[[], T]]) -> list[T]:
    """Return the results of all works, in their order; the copies and this process each take the next one left.

    Raises the error of the first work, in their order, that failed. What a copy leaves undone, since it was killed, is
    done here. One core does it all where copies are not safe: elsewhere than on Linux, beside other threads of Python or
    those of ``UNSAFE``.
    """
    helpers = min(_cores(), len(works)) - 1
    if helpers < 1 or len(works) > MOST or not _safe():
        return [work() for work in works]
    left, places = os.pipe()
    os.write(places, bytes(range(len(works))))
    os.close(places)
    copies: list[tuple[int, int]] = []
    gc.freeze()  # or the first collection in a copy would copy every page
    try:
        for _ in range(helpers):
            copies.append(_copy(works, left, copies))
        done = _take(works, left)
        for _, answers in copies:
            done |= _read(answers)
    finally:
        gc.unfreeze()
        os.close(left)
        for process, answers in copies:
            os.close(answers)
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
            with contextlib.suppress(ChildProcessError):
                os.waitpid(process, 0)
    for place in sorted(set(range(len(works))) - set(done)):
        done[place] = (works[place](), None)
    for _, error in (done[place] for place in range(len(works))):
        if error is not None:
            raise error
    return [done[place][0] for place in range(len(works))]


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else 1


def _safe() -> bool:
    return threading.active_count() == 1 and not any(name in sys.modules for name in UNSAFE)


def _take(works: Sequence[Callable[[], Any]], left: int) -> dict[int, tuple[Any, Exception | None]]:
    """Do works until none is left; returns result and error of each by its place."""
    done: dict[int, tuple[Any, Exception | None]] = {}
    while place := os.read(left, 1):
        try:
            done[place[0]] = (works[place[0]](), None)
        except Exception as error:
            done[place[0]] = (None, error)
    return done


def _copy(works: Sequence[Callable[[], Any]], left: int, others: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Fork a copy that takes works too; returns its number and the pipe that its results come through."""
    answers, results = os.pipe()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    parent = os.getpid()
    with warnings.catch_warnings():
        # newer Pythons warn of threads of any library; those that do not survive are in UNSAFE
        warnings.simplefilter("ignore", DeprecationWarning)
        process = os.fork()
    if process:
        os.close(results)
        return process, answers
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # this process's parent ends it
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        for inherited in (answers, *(pipe for _, pipe in others)):
            os.close(inherited)
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: it ends with its parent
        if os.getppid() == parent:
            content = pickle.dumps(_take(works, left))
            with os.fdopen(results, "wb") as out:
                out.write(content)
    finally:
        os._exit(0)  # what failed here is done again there


def _read(answers: int) -> dict[int, tuple[Any, Exception | None]]:
    with os.fdopen(os.dup(answers), "rb") as pipe:
        content = pipe.read()
    try:
        found: dict[int, tuple[Any, Exception | None]] = pickle.loads(content)
    except Exception:  # it was cut off, or an error cannot be pickled
        return {}
    return found
