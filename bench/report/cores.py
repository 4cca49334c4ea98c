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
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

from bench.model import blocks

UNSAFE = ("jaxlib", "torch._C")
"""Modules whose threads do not survive in a copy."""
T = TypeVar("T")


def spread(works: Sequence[Callable[[], T]]) -> list[T]:
    """Return the results of all works, in their order; this process and its copies take turns.

    Raises the error of the first work, in their order, that failed. What a copy leaves undone, since it was killed, is
    done here. One core does it all where copies are not safe: elsewhere than on Linux, beside other threads of Python or
    those of ``UNSAFE``.
    """
    helpers = min(blocks.cores(), len(works)) - 1
    if helpers < 1 or not _safe():
        return [work() for work in works]
    turns = [range(first, len(works), helpers + 1) for first in range(helpers + 1)]
    copies: list[tuple[int, int]] = []
    gc.freeze()  # or the first collection in a copy would copy every page
    try:
        for places in turns[1:]:
            copies.append(_copy(works, places, copies))
        done = _take(works, turns[0])
        for _, answers in copies:
            done |= _read(answers)
    finally:
        gc.unfreeze()
        for process, answers in copies:
            os.close(answers)
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
            with contextlib.suppress(ChildProcessError):
                os.waitpid(process, 0)
    results = [done[place] if place in done else (work(), None) for place, work in enumerate(works)]
    for _, error in results:
        if error is not None:
            raise error
    return [result for result, _ in results]


def _safe() -> bool:
    alone = threading.active_count() == 1 and not any(name in sys.modules for name in UNSAFE)
    return alone and sys.platform == "linux"


def _take(works: Sequence[Callable[[], Any]], places: Iterable[int]) -> dict[int, tuple[Any, Exception | None]]:
    """Do the works at some places; returns result and error of each by its place."""
    done: dict[int, tuple[Any, Exception | None]] = {}
    for place in places:
        try:
            done[place] = (works[place](), None)
        except Exception as error:
            done[place] = (None, error)
    return done


def _copy(
    works: Sequence[Callable[[], Any]], places: Iterable[int], others: Sequence[tuple[int, int]]
) -> tuple[int, int]:
    """Fork a copy that does the works at some places; returns its number and the pipe that its results come through."""
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
            content = pickle.dumps(_take(works, places))
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
