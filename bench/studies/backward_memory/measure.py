"""Measures processor time and memory of a batch of gradients, and whether the gradient agrees with another backend's."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import Crashed
from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.model import registry
from bench.studies import finite_status, first_batch, relative_error
from bench.studies.backward_memory import BackwardMemory

PROGRAM = (
    "import sys; sys.path[:] = sys.argv.pop().split(chr(0x1f)); "
    "from bench.studies.backward_memory.child import main; main()"
)
"""The program of a cell's process, which has the import path of this one."""
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NPROC": "1",
    "MALLOC_MMAP_THRESHOLD_": str(1 << 17),
}
"""Variables for the cell's process: one thread for numerical libraries, and blocks of 128 KiB and more that the C library
returns to the system when they are freed. By default it raises that limit, and keeps freed blocks for later calls."""


def measure(cell: Cell, session: Session, study: BackwardMemory) -> dict[str, Any]:
    """Return one cell's results by column. Raises :class:`Crashed` if the cell's process ends without a result."""
    answer = in_process(cell, study.calls, session.problems.compilations.folder)
    if "status" in answer:
        return answer
    gradient = np.array(answer["gradient"])
    result = finite_status("the gradient is not finite", gradient) | {
        "gradient": answer["gradient"], **spread("gradient_s", answer["seconds"]), **spread("memory_mb", answer["peaks"]),
        "process_mb": float(np.median(answer["before"])), "compared_with": "",
    }  # fmt: skip
    if cell.ranked_backends:
        other = session.problems.of(cell.ranked_backends[0], cell)
        expected = other.grad(other.program.theta0, first_batch(cell, other.program.n_noise)).mean(axis=1)
        error = relative_error(gradient, expected)
        result |= {"compared_with": cell.ranked_backends[0].name, "gradient_error_rel": error}
    return result


def in_process(cell: Cell, calls: int, cache: Path | None) -> dict[str, Any]:
    """Return the results of :func:`child.measured` in a new process, or the status and reason of its error."""
    with tempfile.TemporaryFile() as file:
        given = pickle.dumps((registry.folders(), pickle.dumps((cell, calls, cache))))
        words = [sys.executable, "-c", PROGRAM, str(file.fileno()), chr(0x1F).join(sys.path)]
        ended = subprocess.run(words, input=given, pass_fds=[file.fileno()], env=os.environ | ENVIRONMENT, check=False)
        file.seek(0)
        content = file.read()
    if ended.returncode or not content:
        raise Crashed(f"the process that computes the gradients ended with exit status {ended.returncode}")
    result: dict[str, Any] = json.loads(content)
    return result


def spread(name: str, values: list[float]) -> dict[str, float]:
    """Return the median of some values as column ``name``, and their range as ``name_low`` and ``name_high``.

    The range of n independent values contains their distribution's median with probability 1 - 2^(1 - n).
    """
    return {name: float(np.median(values)), f"{name}_low": min(values), f"{name}_high": max(values)}
