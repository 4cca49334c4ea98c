"""Memory and time of a gradient along the horizon, by what its backward pass keeps."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from bench.errors import Crashed
from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, ComparisonRule, interval, numbers, text
from bench.experiment.session import Session
from bench.model import param, registry

from .. import StudyPackage, finite_status, first_batch, relative_error

PROGRAM = (
    "import sys; sys.path[:] = sys.argv.pop().split(chr(0x1f)); "
    "from bench.plugins.studies.backward_memory.child import main; main()"
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


@dataclass(frozen=True)
class BackwardMemory(StudyPackage):
    """Measures the peak memory and the time of a batch of gradients on each backend, each cell in its own process."""

    name = "backward_memory"
    axes: ClassVar[tuple[str, ...]] = ("scene", "contact", "integrator", "backend")
    columns: ClassVar[Columns] = Columns.of(
        interval("memory_mb", "largest resident memory during `samples` gradients beyond the memory before, median over calls",
               "MiB", label="memory", measured=True),
        Column("memory_mb_low", "smallest of the calls: lower end of the interval", "MiB", measured=True),
        Column("memory_mb_high", "largest of the calls: upper end of the interval", "MiB", measured=True),
        interval("gradient_s", "processor time of `samples` gradients on one thread, median over calls", "s", label="gradients", measured=True, format="seconds"),
        Column("gradient_s_low", "smallest of the calls: lower end of the interval", "s", measured=True),
        Column("gradient_s_high", "largest of the calls: upper end of the interval", "s", measured=True),
        Column("process_mb", "resident memory before the gradients: libraries, compiled program, theta and noise", "MiB",
               label="process", measured=True),
        Column("gradient_error_rel", "distance of the mean gradient from that of the backend in `compared_with`, relative to "
               "its norm", label="difference", comparison=ComparisonRule("exact", "difference of gradients")),
        text("compared_with", "backend of the gradient that gradient_error_rel compares with"),
        numbers("gradient", "mean gradient of the batch, by coordinate of theta",
                comparison=ComparisonRule("vector", "gradient")),
    )  # fmt: skip
    timed: ClassVar[bool] = True

    calls: int = param(
        6, "measured calls: the range of six contains the median of their distribution with probability 97%", low=6
    )

    def refusal(self, cell: Cell) -> str | None:
        """Return that the backend computes no gradients, or None."""
        return None if "grad" in cell.backend.provides else f"backend {cell.backend.name} computes no gradients"

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column. Raises :class:`Crashed` if the cell's process ends without a result."""
        answer = in_process(cell, self.calls, session.problems.compilations.folder)
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
