"""The contract of a study: what is measured of each cell, and how it is shown."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from bench.errors import UserError
from bench.experiment.cell import Cell
from bench.experiment.columns import Columns
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.model.parameters import Plugin

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Study(Plugin):
    """Measures something in each cell, and turns rows into tables, charts and a page.

    A study is found like any plugin: by its folder under ``bench/studies``, in a folder of the user's own, or by an
    entry point.
    """

    kind: ClassVar[str] = "studies"
    axes: ClassVar[tuple[str, ...]] = ("scene", "contact", "integrator", "backend", "estimator")
    """The axes of its grid, each a kind of plugins in the singular."""
    columns: ClassVar[Columns]
    """The columns of its rows."""
    timed: ClassVar[bool] = False
    """Whether its cells are timed unless the user says otherwise: one at a time, with the machine to themselves."""

    @abstractmethod
    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return status, reason and the study's columns for one cell; an exception becomes status and reason."""

    def parts(self, given: dict[str, Plugin | None]) -> dict[str, Plugin | None]:
        """Return a cell's plugins by axis, without those that make no difference to it; by default all."""
        return given

    def unsupported_reason(self, cell: Cell) -> str | None:
        """Return why the study cannot measure a cell, or None; asked when a run is planned."""
        return None

    @abstractmethod
    def write(self, experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
        """Write tables and charts from rows, and return the files' paths; it prints nothing."""

    def show(self, experiment: Experiment, rows: pd.DataFrame) -> None:
        """Print what the user should see first."""

    def page(self, experiment: Experiment, rows: pd.DataFrame) -> Any:
        """Return a :class:`bench.report.web.content.Content`; None for a table and a chart of any two numbers."""
        return None

    def chart(self, experiment: Experiment, rows: pd.DataFrame) -> Sequence[str]:
        """Return the chart's file names in a gallery, without ending, best first."""
        return [experiment.name, self.name]

    def faults(self, rows: pd.DataFrame) -> int:
        """Count rows with a fault, such as a gradient no one should use; ``gradcheck`` then ends with status 1."""
        return 0


def study_of(experiment: Experiment) -> Study:
    """Return the experiment's study; raises :class:`UserError` for a plugin that is not a :class:`Study`."""
    study = experiment.study
    if not isinstance(study, Study):
        raise UserError(f"study {study.name} does not derive from bench.Study")
    return study
