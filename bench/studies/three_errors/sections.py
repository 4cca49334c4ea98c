"""Splits the rows by the axis along which errors are compared, and finds the traps along the time step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis
from bench.report.problems import problem_names, problem_numbers
from bench.report.text import number
from bench.report.views import Arranged, attempted, merge_seeds, rows_along

EXACT = 1e-6
"""Program error up to which a gradient counts as exact."""
CONVERGED = 0.5
"""A cost or gradient converges if its error falls at least to this share from the largest to the smallest step."""
WRONG = 0.1
"""Smallest model error of a wrong gradient."""
PROGRAM = ("scene", "contact", "integrator", "backend")
"""Parts of the grid that identify a program. It has one bias per estimator."""
STEP = "dt"
"""Column of the time step, along which costs and gradients may converge."""


@dataclass(frozen=True, eq=False)
class Section:
    """The rows of one table, along an axis with its values in the column ``x``; without an axis, ``x`` is 0."""

    axis: Axis | None
    rows: pd.DataFrame

    @property
    def heading(self) -> str:
        """The heading of the table: ``Along dt [s], with horizon``."""
        return "Not along a swept axis" if self.axis is None else f"Along {self.axis.title}"

    @property
    def is_along_steps(self) -> bool:
        """Whether the axis is the time step."""
        return self.axis is not None and self.axis.column == STEP


def sections(shown: Arranged) -> list[Section]:
    """Return a section per swept axis, with the programs that vary along it, then one with all other programs.

    In a section of an axis, all other axes are fixed at their most common value. Axes that step together have one
    section: the section of the time step if it is one of them, else of the first axis.
    """
    parts: list[Section] = []
    for axis in _independent_axes(shown):
        joint = joint_axes(shown, axis)
        part = attempted(rows_along(shown, axis))
        for other in shown.axes:
            if other not in joint and other.column != "seed" and not part.empty:
                part = part[_is_most_common(part, other, shown)]
        if part.empty:
            continue
        varies = part.groupby(problem_numbers(part, PROGRAM, joint))["x"].transform("nunique") > 1
        if varies.any():
            parts.append(Section(axis, part[varies].sort_values("x", kind="stable")))
    rest = attempted(merge_seeds(shown.rows)).assign(x=0.0)
    programs = problem_numbers(rest, PROGRAM, shown.axes)
    listed = {key for part in parts for key in part.rows["key"]}
    rest = rest[~programs.isin(programs[rest["key"].isin(listed)])]
    return parts + ([] if rest.empty else [Section(None, rest)])


def _independent_axes(shown: Arranged) -> list[Axis]:
    """Return the axes that have a section: one of each set of axes that step together."""
    axes: list[Axis] = []
    for axis in sorted(shown.axes, key=lambda axis: axis.column != STEP):
        if axis.column != "seed" and not any(axis.column in other.moves for other in axes):
            axes.append(axis)
    return [axis for axis in shown.axes if axis in axes]


def joint_axes(shown: Arranged, axis: Axis | None) -> list[Axis]:
    """Return an axis and the axes that step with it; empty for None."""
    return [] if axis is None else [axis, *(other for other in shown.axes if other.column in axis.moves)]


def _is_most_common(rows: pd.DataFrame, axis: Axis, shown: Arranged) -> pd.Series:
    """Return a mask of the rows at their scene and law's most common value of an axis, or without a value."""
    laws = problem_numbers(rows, ("scene", "contact"), shown.axes)
    mode = rows.groupby(laws)[axis.column].transform(lambda v: v.mode().iloc[0] if v.notna().any() else np.nan)
    return (rows[axis.column] == mode) | rows[axis.column].isna()


def programs_of(shown: Arranged, part: Section, parts: Sequence[str] = PROGRAM) -> pd.Series:
    """Return, per row of a section, the name of its program, ``bounce_once, penalty``, which is the same along the axis."""
    always = [name for name in ("scene", "contact") if name in parts]
    return problem_names(shown, parts, joint_axes(shown, part.axis), always, part.rows)


# -------------------------------------------------------------------------------------------------------- traps


@dataclass(frozen=True)
class Trap:
    """A program with a converging cost and an exact gradient that is nevertheless wrong for the physics.

    Its cosine to the physical gradient is negative at every step, or its model error does not converge with the step.
    """

    name: str
    """Name of the program: scene, law and the parameters that distinguish it."""
    program: float
    """Largest relative program error."""
    forward: tuple[float, float]
    """Relative forward error at the largest and the smallest value of the axis."""
    cosine: tuple[float, float]
    """Smallest and largest cosine to the physical gradient."""
    model: tuple[float, float]
    """Relative model error at the largest and the smallest value of the axis."""

    def __str__(self) -> str:
        """Format the trap as two sentences."""
        cosines = f"{number(self.cosine[0])} to {number(self.cosine[1])}"
        against = (
            f"but the cosine to the physical gradient is negative at every time step ({cosines})."
            if self.cosine[1] < 0
            else f"but the error to the physical gradient does not converge: it is {number(self.model[0])} at the largest time "
            f"step and {number(self.model[1])} at the smallest (cosine {cosines})."
        )
        return (
            f"Trap: {self.name}: the gradient agrees with differences to {number(self.program)}. The cost's error falls "
            f"from {number(self.forward[0])} to {number(self.forward[1])} with the time step, {against}"
        )


def traps(shown: Arranged, parts: Sequence[Section]) -> list[Trap]:
    """Return the programs that are traps along the time step; a missing error is never a trap."""
    part = next((part for part in parts if part.is_along_steps), None)
    if part is None:
        return []
    result = []
    for name, rows in part.rows.groupby(programs_of(shown, part), sort=False):
        steps = rows.drop_duplicates("x").sort_values("x")
        forward, cosine, model = (steps[name] for name in ("forward_error_rel", "model_cosine", "model_error_rel"))
        program = steps["program_error_rel"].max(skipna=False)
        converges = forward.is_monotonic_increasing and forward.iloc[0] <= CONVERGED * forward.iloc[-1]
        stays_wrong = model.iloc[0] > max(CONVERGED * model.iloc[-1], WRONG)
        if ((cosine < 0).all() or stays_wrong) and program <= EXACT and converges:
            ends, errors = ((float(v.iloc[-1]), float(v.iloc[0])) for v in (forward, model))
            result.append(Trap(str(name), float(program), ends, (float(cosine.min()), float(cosine.max())), errors))
    return result
