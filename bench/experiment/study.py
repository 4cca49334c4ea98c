"""The contract of a study: what it measures in each cell, and what it shows of the rows."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from bench.experiment.cell import Cell
from bench.experiment.columns import Columns
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.views import Views
from bench.host.parameters import Plugin
from bench.model import Decision, registry

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Study(Plugin):
    """Measures each cell, and says what to show of the rows: tables and charts, as data.

    A study is registered like any plugin: as a file or package under ``plugins/studies``, in a plugin folder of the user, or by an
    entry point.
    """

    kind: ClassVar[str] = "studies"
    axes: ClassVar[tuple[str, ...]] = ("scene", "contact", "integrator", "backend", "estimator")
    """The axes of its grid, each a kind of plugin in the singular."""
    columns: ClassVar[Columns]
    """The columns of its rows."""
    timed: ClassVar[bool] = False
    """Whether its cells are timed by default: one at a time, with the machine to themselves."""
    fresh_process: ClassVar[bool] = False
    """Whether each cell runs in a worker of its own, with one thread, as measurements of memory need."""
    descends: ClassVar[bool] = True
    """Whether its cells are measured at ``program.theta0``, and so at a share of a descent."""

    default_plugins: ClassVar[Mapping[str, Sequence[str]]] = {}
    """Names of the plugins of a kind that the configuration leaves null, such as ``optimizers``."""

    @abstractmethod
    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return status, reason and the study's columns for one cell. An exception becomes status and reason."""

    def parts(self, given: dict[str, Plugin | None]) -> dict[str, Plugin | None]:
        """Return a cell's plugins by axis, without plugins that do not affect its results; by default all of ``given``."""
        return given

    def decision(self, given: Decision) -> Decision:
        """Return the part of theta that programs have; by default all of it."""
        return given

    def compares(self, parts: Mapping[str, Plugin | None]) -> bool:
        """Return whether a cell with these plugins needs a reference gradient; by default if the rows have its method."""
        return "reference_method" in self.columns.by_name

    def refusal(self, cell: Cell) -> str | None:
        """Return why the study cannot measure a cell, or None; called when a run is planned."""
        return None

    def views(self, experiment: Experiment, rows: pd.DataFrame) -> Views | None:
        """Return what the study shows of its rows, as data; None for a table and a chart of any two of its numbers."""
        return None

    def faults(self, rows: pd.DataFrame) -> int:
        """Return the number of rows with a fault, such as a wrong gradient: ``gradcheck`` then exits with 1."""
        return 0

    def failure(self, rows: pd.DataFrame) -> str:
        """Return why measured rows do not pass as a rung of a ladder, in words; empty if they pass, as without faults."""
        count = self.faults(rows)
        return f"{count} of {len(rows)} cells {'has' if count == 1 else 'have'} a fault" if count else ""


def columns_of(study: str) -> Columns:
    """Return the columns of a study's rows; those of all studies if it is not installed."""
    entry = registry.entries()["studies"].get(study)
    return entry.plugin.columns if entry and entry.plugin and issubclass(entry.plugin, Study) else Columns.of()
