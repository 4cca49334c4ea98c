"""What a study may ask of the run that it measures a cell in."""

from __future__ import annotations

from typing import Protocol

from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.problems import Problems
from bench.measure.reference import Reference
from bench.model import Compilations, Problem


class ReferenceSource(Protocol):
    """Reference gradients by cell."""

    def of(self, cell: Cell) -> Reference:
        """Return the reference gradient of a cell, computed or stored; raises what its computation raises."""


class Session(Protocol):
    """The compiled problems and reference gradients that the cells of one run share."""

    experiment: Experiment
    problems: Problems

    @property
    def references(self) -> ReferenceSource:
        """The reference gradients of the run."""

    def problem(self, cell: Cell) -> Problem:
        """Return the cell's program, compiled on its backend."""

    @property
    def compilations(self) -> Compilations:
        """Compilations of the run's problems since the count was restarted."""
