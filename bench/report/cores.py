"""Runs tasks on several cores, in forked processes that share this process's memory."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import Any, TypeVar

import psutil

from bench.model import blocks, guard

UNSAFE = ("jaxlib", "torch._C")
"""Modules whose threads do not survive a fork."""
T = TypeVar("T")
_tasks: Sequence[Callable[[], Any]] = ()
"""The tasks of the current pool. Workers inherit them by the fork, because closures cannot be pickled."""


def run_tasks(tasks: Sequence[Callable[[], T]]) -> list[T]:
    """Run tasks in forked processes and return their results in order.

    Re-raises the first task error, in task order. Tasks of a killed process, and tasks whose result cannot be pickled,
    are rerun in this process. All tasks run in this process if a fork is not safe: on other systems than Linux, with
    other Python threads, or after a module of :data:`UNSAFE` was imported.
    """
    n_workers = min(blocks.cores(), len(tasks))
    is_safe = threading.active_count() == 1 and not any(name in sys.modules for name in UNSAFE)
    if n_workers < 2 or not is_safe or sys.platform != "linux":
        return [task() for task in tasks]
    results = []
    for task, future in zip(tasks, _finished(tasks, n_workers), strict=True):
        try:
            result, error = pickle.loads(future.result())
        except (Exception, SystemExit):  # the worker ended, or result or error cannot be pickled
            result, error = task(), None
        if error is not None:
            raise error
        results.append(result)
    return results


def _finished(tasks: Sequence[Callable[[], Any]], n_workers: int) -> list[Future[bytes]]:
    """Run all tasks and return their completed futures; an interrupt kills the workers."""
    global _tasks
    others = set(psutil.Process().children())
    interrupts: list[tuple[Any, ...]] = []

    def kill() -> None:
        for worker in set(psutil.Process().children()) - others:
            with contextlib.suppress(psutil.Error):
                worker.kill()

    def interrupt(*arguments: Any) -> None:
        """Kill the workers, which ends the waiting. Raising here could leave a worker that has only just been forked."""
        interrupts.append(arguments)
        kill()

    start = partial(_start_worker, os.getpid())
    outer, _tasks = _tasks, tasks
    handler: Any = signal.getsignal(signal.SIGINT)
    gc.freeze()  # without this, the first garbage collection in a worker would copy all memory pages
    try:
        if callable(handler):
            signal.signal(signal.SIGINT, interrupt)
        pool = ProcessPoolExecutor(n_workers, multiprocessing.get_context("fork"), start)
        with pool, warnings.catch_warnings():
            # newer Pythons warn about any library's threads; libraries whose threads do not survive a fork are in UNSAFE
            warnings.simplefilter("ignore", DeprecationWarning)
            try:
                futures = [_submitted(pool, place) for place in range(len(tasks))]
                if interrupts:
                    kill()  # workers that were started after the interrupt
                for future in futures:
                    future.exception()
            except BaseException:
                kill()
                raise
    finally:
        _tasks = outer
        gc.unfreeze()
        if callable(handler):
            signal.signal(signal.SIGINT, handler)
    if interrupts:
        handler(*interrupts[0])
    return futures


def _submitted(pool: ProcessPoolExecutor, place: int) -> Future[bytes]:
    """Submit the task at this place; if a worker has already been killed, the future has this error."""
    try:
        return pool.submit(_run, place)
    except BrokenProcessPool as error:
        future: Future[bytes] = Future()
        future.set_exception(error)
        return future


def _start_worker(parent: int) -> None:
    """Make this worker ignore interrupts, which its parent process handles, and end when the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    if os.getppid() != parent:
        os._exit(1)


def _run(place: int) -> bytes:
    """Run a task and return its result and its error, pickled."""
    try:
        outcome: tuple[Any, Exception | None] = (_tasks[place](), None)
    except Exception as error:
        outcome = (None, error)
    guard.kill_children()  # of a plugin, which nobody would find once this process has ended
    return pickle.dumps(outcome)
