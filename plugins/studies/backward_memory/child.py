"""Measures time and memory of one cell's gradients in a process of its own, so that peaks of cells do not mix."""

from __future__ import annotations

import ctypes
import gc
import json
import os
import pickle
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from bench.errors import failure
from bench.experiment.cell import Cell
from bench.measure import timing
from bench.model import Compilations, registry

from .. import first_batch


def main() -> None:
    """Measure the cell on stdin, and write the result as JSON to the file descriptor in ``sys.argv``."""
    descriptor = int(sys.argv[1])
    folders, given = pickle.loads(sys.stdin.buffer.read())
    try:
        for folder in folders:
            registry.add_folder(folder)
        # pickled separately, since its classes may come from the folders of plugins
        result = measured(*pickle.loads(given))
    except BaseException as error:
        result = dict(failure(error))
    os.write(descriptor, json.dumps(result).encode())


def measured(cell: Cell, calls: int, cache: Path | None) -> dict[str, Any]:
    """Return the mean gradient, and processor times [s] and peaks of memory [MiB] of some calls after one that compiles.

    The whole batch is one block on one thread. Memory freed by earlier calls is returned to the system before each call.
    On one thread, processor time is the time on an otherwise idle machine, and other load hardly changes it.
    """
    problem = cell.backend.compile(cell.program())
    problem.compilations = Compilations(cache)
    problem.block, problem.threads = cell.samples, 1
    theta = problem.program.theta0
    w = first_batch(cell, problem.program.n_noise)
    gradient = problem.grad(theta, w).mean(axis=1)
    seconds, peaks, before = [], [], []
    for _ in range(calls):
        gc.collect()
        with suppress(AttributeError, OSError):  # glibc only
            ctypes.CDLL(None).malloc_trim(0)
        timing.reset_peak_memory()
        before.append(timing.peak_memory_mb())
        started = time.process_time()
        problem.grad(theta, w)
        seconds.append(time.process_time() - started)
        peaks.append(timing.peak_memory_mb() - before[-1])
    return {"gradient": gradient.tolist(), "seconds": seconds, "peaks": peaks, "before": before}
