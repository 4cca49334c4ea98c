"""Measures what an error in the gradient costs: updates to a target against the error, within a problem and an optimizer."""

from __future__ import annotations

from dataclasses import dataclass

from bench.plugins.studies.optimise import SearchStudy

from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, seconds, setting, several, text
from bench.model import param

REVISION = 1
"""Raised when a stored number moves: the stored rows belong to a revision and not to the content of these files."""


@dataclass(frozen=True)
class DoseResponse(SearchStudy):
    """Searches with gradients of known error at their best rate, and counts the updates until the regret has fallen."""

    name = "dose_response"
    columns = Columns.of(
        text("optimizer", "identity string of the optimizer"),
        text(
            "scene_class",
            "smooth, stiff (contact), chaotic (gradients vary more than costs), discontinuous or identification",
            label="class",
        ),
        Column(
            "error",
            "root mean squared error of the gradient relative to its norm, median over ten thetas of a path that "
            "all methods of the problem share",
            label="relative error",
        ),
        Column("bias", "norm of the mean error relative to the gradient's norm, median over the thetas"),
        Column("spread", "root mean squared distance of an estimate from their mean, relative, median over the thetas"),
        Column("cosine", "mean cosine of estimate and gradient, median over the thetas"),
        Column(
            "sign_agreement", "share of components with the right sign, median over the thetas", label="right signs"
        ),
        Column("error_start", "relative error at the start"),
        setting("budget", "most updates of a search: a search that misses a target is censored there"),
        setting("runs", "searches that score; 1 if the gradient does not depend on the noise"),
        Column(
            "lowest",
            "lowest regret of the searches at the rate of the last target, share of the first, median",
            comparison=ComparisonRule("exact", "lowest regret"),
        ),
        Column("start_cost", "objective at the start"),
        Column("optimum", "lowest cost known, from before the searches", label="J*"),
        text("optimum_status", "source of the optimum"),
        Column("rollouts_per_update", "costs of an update"),
        Column("gradients_per_update", "gradients of an update"),
        Column("tuning_rollouts", "costs of all searches that choose the rate"),
        Column("tuning_gradients", "gradients of all searches that choose the rate"),
        seconds("rollout_s", "time of a cost in a batch of 256", untimed=True),
        seconds("gradient_s", "time of a gradient in a batch of 256", untimed=True),
        text("hypotheses", "hash of the file of hypotheses at the time of the measurement"),
        *several(
            numbers,
            {
                "updates": "updates to 1/10, 1/30, 1/100, 1/300 and 1/1000 of the first regret, `runs` each; empty: missed",
                "best_rates": "rate of each target, chosen on seeds that do not score",
                "is_inside": "whether the rate of each target is inside the grid of rates",
                "rates": "rates tried",
                "rate_updates": "median updates to each target at each rate",
                "path_errors": "relative error at each of the ten thetas",
            },
            table=False,
        ),
    )

    iterations: int = param(200, "most updates of a search", positive=True)
    seeds: int = param(6, "searches that score, if gradients depend on the noise", positive=True)
    tuning_seeds: int = param(3, "searches per rate that choose the rate", positive=True)
    rates: int = param(7, "rates of the first grid, half a decade apart", low=3)
    widenings: int = param(3, "times that the grid is widened by two rates where the best is at its edge", low=0)

    def grid(self) -> list[float]:
        """Return the first grid of rates, in units of the largest element of the first step: 0.003 to 3 for 7 rates."""
        half = (self.rates - 1) / 2
        return [0.1 * 10 ** (0.5 * (i - half)) for i in range(self.rates)]
