"""Checks whether the program's gradient is the derivative of its cost, at theta0 and around a contact switch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from bench.experiment.cell import Cell
from bench.experiment.columns import Columns
from bench.experiment.session import Session
from bench.model import param

from .. import StudyPackage
from .columns import COLUMNS

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class GradientCheck(StudyPackage):
    """Checks the program's gradient against differences of its cost, at theta0 and around a contact switch."""

    name = "gradient_check"
    columns: ClassVar[Columns] = COLUMNS

    directions: int = param(2, "directions of the checks at the start, and of those at a switch", positive=True)
    drawn: int = param(16, "directions along which a contact switch is looked for", positive=True)
    reach: float = param(
        2.0, "how far along a direction a switch is looked for, in units of the scale of theta", positive=True
    )
    aside: float = param(
        1e-4, "how far before and after a switch gradients are checked, in the same units", positive=True
    )

    around: int = param(8, "other thetas around the start at which gradients are checked", low=1)

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column: all checks, and the shell command that repeats them."""
        from bench.report.reproduce import check_of

        return super().measure(cell, session) | {"command": check_of(cell)}

    def faults(self, rows: pd.DataFrame) -> int:
        """Return the number of rows with a gradient that cannot be trusted, or without a finite cost."""
        return int(((rows["untrusted"] > 0) | (rows["status"] == "nonfinite")).sum())

    def failure(self, rows: pd.DataFrame) -> str:
        """Return which checks show a gradient that is wrong or open; empty without any, also where noise reaches a jump."""
        from .lines import not_right

        return not_right(rows)
