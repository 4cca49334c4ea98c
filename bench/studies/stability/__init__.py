"""The stability map: where a gradient is right, wrong or lost, over step size and stiffness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, text
from bench.model import param
from bench.studies import StudyPackage

WORST_FIRST = ("nonfinite", "diverged", "wrong_sign", "zero", "inaccurate", "unresolved", "ok")


@dataclass(frozen=True)
class Stability(StudyPackage):
    """Measures where a program's gradient is right, inaccurate, of wrong sign, zero or lost, one rollout per cell."""

    name = "stability"
    columns: ClassVar[Columns] = Columns.of(
        Column("first_bad_step", "first step at which the state diverged or was not finite"),
        Column("growth_factor", "measured growth of the state per step, where the motion is linear"),
        Column("spectral_radius", "of one step on the cell's oscillator, in theory"),
        Column("stiffness_limit", "stiffness at which that radius leaves 1", "N/m"),
        Column(
            "relative_error",
            "norm of (gradient - truth) / norm of the truth",
            comparison=ComparisonRule("exact", "error"),
        ),
        Column("cosine", "cosine between gradient and truth"),
        Column("grad_norm", "norm of the gradient"),
        Column("truth_norm", "norm of the truth"),
        Column("truth_error", "relative change of the truth on its last refinement"),
        text("verdict", "ok, or what is wrong", comparison=ComparisonRule("verdict", "verdict", order=WORST_FIRST)),
        text("truth", "how the truth was computed: physical or refined"),
        text("cause", "of a finite but wrong gradient: step (or how it is differentiated), law, both or unknown"),
        Column(
            "step_error",
            "distance from the law's own gradient, which is differences of its cost at a far finer step, / norm of the truth",
        ),
        Column("law_error", "distance of the law's own gradient from the truth / norm of the truth"),
        numbers("state_at_first_bad_step", "the state at the first bad step"),
    )

    diverged: float = param(
        10.0, "multiple of the initial scale beyond which a state component has diverged", positive=True
    )
    grown: float = param(
        1.1, "growth over the rollout of a state that cannot grow, from which it has diverged", low=1.0
    )
    inaccurate: float = param(0.1, "relative error of the gradient above which it is wrong", positive=True)
    fine_steps: int = param(
        1 << 14, "fewest steps of the refined truth; half as many say how far it has converged", low=2
    )
    finer: int = param(4, "fewest steps of the refined truth to one of the cell's", positive=True)
