"""Memory and time of a gradient along the horizon, by what its backward pass keeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, text
from bench.model import param
from bench.studies import StudyPackage


@dataclass(frozen=True)
class BackwardMemory(StudyPackage):
    """Measures the peak memory and the time of a batch of gradients on each backend, each cell in its own process."""

    name = "backward_memory"
    axes: ClassVar[tuple[str, ...]] = ("scene", "contact", "integrator", "backend")
    columns: ClassVar[Columns] = Columns.of(
        Column("memory_mb", "largest resident memory during `samples` gradients beyond the memory before, median over calls",
               "MiB", label="memory", low="memory_mb_low", high="memory_mb_high", measured=True),
        Column("memory_mb_low", "smallest of the calls: lower end of the interval", "MiB", measured=True),
        Column("memory_mb_high", "largest of the calls: upper end of the interval", "MiB", measured=True),
        Column("gradient_s", "processor time of `samples` gradients on one thread, median over calls", "s", label="gradients",
               low="gradient_s_low", high="gradient_s_high", measured=True, format="seconds"),
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

    def unsupported_reason(self, cell: Cell) -> str | None:
        """Return that the backend computes no gradients, or None."""
        return None if "grad" in cell.backend.provides else f"backend {cell.backend.name} computes no gradients"
