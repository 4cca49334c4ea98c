"""The session of a run: the compiled problems and reference gradients that its cells share."""

from __future__ import annotations

from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.session import Problems
from bench.model import Compilations, Problem
from bench.run.references import References


class Session:
    """The compiled problems and reference gradients of one run."""

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self.problems = Problems(experiment.compile_cache)
        self.references = References(experiment, self.problems)

    def problem(self, cell: Cell) -> Problem:
        """Return the cell's program, compiled on its backend."""
        return self.problems.of(cell.backend, cell)

    @property
    def compilations(self) -> Compilations:
        """Compilations of the run's problems since the count was restarted."""
        return self.problems.compilations
