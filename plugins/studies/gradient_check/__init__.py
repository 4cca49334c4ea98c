"""Checks whether the program's gradient is the derivative of its cost, at theta0 and around a contact switch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, several, text
from bench.experiment.session import Session
from bench.gradient import BROKEN, TRUSTED, VERDICTS
from bench.model import param

from .. import StudyPackage

if TYPE_CHECKING:
    import pandas as pd

POINTS = ("start", "before", "at", "after", "noise")
"""``start`` is theta0. The next three are on a line through theta0: before, at and after a switch of contact mode. ``noise``
is theta0 under noise at which a cost or gradient is not a number, or the mean of gradients misses a part of the slope."""


def is_trusted(point: str, verdict: str) -> bool:
    """Return whether a check passed. At a contact switch, kinks and jumps are expected."""
    return verdict in TRUSTED or (point == "at" and verdict in BROKEN)


@dataclass(frozen=True)
class GradientCheck(StudyPackage):
    """Checks the program's gradient against differences of its cost, at theta0 and around a contact switch."""

    name = "gradient_check"
    columns = Columns.of(
        *several(
            Column,
            {
                "untrusted": "number of checks that show a gradient not to be trusted",
                "best_error": "smallest relative error over all steps, of the worst check",
                "best_eps": "step of that error, in units of the natural scale",
                "scale": "natural scale of displacements of theta: its norm, at least 1",
                "taylor_order": "order of the Taylor remainder along random directions: 2 for a right gradient, 1 if wrong",
                "spread": "standard deviation of an estimate by `samples` gradients under noise over the norm of their mean",
                "cost_noise": "measured standard deviation of the cost's own noise",
                "jump": "largest jump of the cost that the noise reaches; 0 where none was found",
                "jump_share": "that jump as a share of the range of the cost under the noise",
                "jump_distance": "distance of that jump from theta, in standard deviations of the noise",
            },
        ),
        text(
            "verdict",
            "the worst verdict of the checks",
            comparison=ComparisonRule("verdict", "verdict", order=VERDICTS),
        ),
        text(
            "trusted",
            "whether estimates by fobg can be trusted: yes where they spread by less than half of their mean, and no check "
            "outside a contact switch finds anything against the gradient",
        ),
        text("command", "a line for the shell that repeats the checks"),
        text("device", "what the program ran on"),
        *several(
            numbers,
            {
                "component": "components of theta that were checked one by one",
                "component_program": "of each component, the program's number",
                "component_difference": "of each component, what the differences settle on",
                "component_uncertainty": "of each component, the error of that",
                "component_step": "of each component, the step it was taken at, in units of the component",
                "component_ratio": "of each component, the program's number over the difference",
                "component_left": "of each component, the one-sided slope towards smaller values",
                "component_right": "of each component, the one-sided slope towards larger values",
                "component_verdict": "of each component, its verdict",
                "point": "where each check was made: start, before, at or after a contact switch, or noise: at a jump or a lost number that the noise reaches",
                "sample": "of each check, 0 without noise, 1 with it",
                "direction": "of each check, the number of its direction; -1 - i for component i",
                "contact_switch": "of each check at a contact switch, the contact and the first step that differ between its two sides",
                "derivative_program": "of each check, the program's directional derivative",
                "check_verdict": "of each check, its verdict",
                "check_error": "of each check, the smallest relative error over all steps",
                "check_eps": "of each check, the step of that error",
                "eps": "the steps of the differences, in units of the scale",
                "derivative_differences": "of each check and step, the central difference",
                "relative_error": "of each check and step, its relative error",
                "mode_minus": "of each check and step, the contact mode on the minus side",
                "mode_plus": "of each check and step, the contact mode on the plus side",
            },
        ),
    )

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
        from .views import not_right

        return not_right(rows)
