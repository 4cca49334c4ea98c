"""Measures whether a better gradient finds a better theta sooner: one search per problem, estimator, optimizer and seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, exact, numbers, seconds, several, text
from bench.model import Optimizer, Plugin, param

from .. import PARTS, StudyPackage
from ..bias_variance.columns import COLUMNS as ESTIMATES


def search_parts(cell: Cell) -> tuple[Any, Any]:
    """Return the optimizer of a search and its estimator, which may be None."""
    return cell.parts["optimizer"], cell.parts["estimator"]


@dataclass(frozen=True)
class SearchStudy(StudyPackage):
    """A study whose cells search with an optimizer."""

    axes = (*PARTS, "estimator", "optimizer")
    default_plugins: ClassVar[Mapping[str, Sequence[str]]] = {"optimizers": ("adam",)}

    def parts(self, given: dict[str, Plugin | None]) -> dict[str, Plugin | None]:
        """Return the plugins, without the estimator if the optimizer uses only costs: it then has no effect."""
        optimizer = given.get("optimizer")
        if isinstance(optimizer, Optimizer) and "gradient" not in optimizer.needs:
            return given | {"estimator": None}
        return given

    def refusal(self, cell: Cell) -> str | None:
        """Return what the optimizer needs and no part of the cell provides, or None."""
        optimizer, estimator = search_parts(cell)
        available = {"value"} | ({"gradient"} if estimator is not None else set())
        missing = sorted(optimizer.needs - available)
        if missing:
            source = f"estimator {estimator.name}" if estimator is not None else f"scene {cell.scene.name}"
            return f"optimizer {optimizer.name} needs {' and '.join(missing)}, which {source} does not provide"
        return None


@dataclass(frozen=True)
class Optimise(SearchStudy):
    """Searches for the best theta with each estimator and optimizer, and records the path."""

    name = "optimise"
    timed = True
    columns = Columns.of(
        *(ESTIMATES.by_name[name] for name in ("reference_method", "reference_spacing")),
        text("optimizer", "identity string of the optimizer"),
        text("stopped", "reason for the end of the search: budget or diverged"),
        text(
            "scene_class",
            "smooth, stiff (contact), chaotic (gradients vary more than costs), discontinuous or identification",
            label="class",
        ),
        Column("iterations", "steps of the optimizer"),
        Column("rollouts", "rollouts of the search, without those that score its path"),
        Column("gradients", "gradients of the search"),
        Column("gradient_ratio", "measured time of a gradient over that of a rollout", measured=True),
        seconds("search_s", "time of the search, without compilation and scores", "search"),
        Column("start_cost", "objective at the start"),
        exact("final_cost", "objective at the last theta", "final cost"),
        Column("best_cost", "lowest objective on the path"),
        Column("optimum", "least known cost J*, from before the search"),
        text("optimum_status", "source of J*"),
        Column("score", "share of the way from the start to J*, between 0 and 1; empty without J*"),
        Column(
            "quality_rmse_rel",
            "relative root mean squared error of the estimator's gradients at the start",
            label="gradient's error, relative",
        ),
        Column("quality_cosine", "mean cosine between those gradients and the reference"),
        Column("quality_bias_share", "share of bias in the squared error of those gradients", label="share of bias"),
        *several(
            numbers,
            {
                "path_iteration": "iterations at which the path is recorded",
                "path_cost": "objective at those iterations",
                "path_rollouts": "rollouts up to those iterations",
                "path_gradients": "gradients up to those iterations",
            },
            table=False,
        ),
        numbers("path_s", "time up to those iterations", "s", table=False, measured=True),
        numbers("theta", "the last theta", table=False),
    )

    budget: int = param(20_000, "rollouts that a search may spend, a gradient counting as gradient_cost", positive=True)
    gradient_cost: float = param(4.0, "rollouts that a gradient counts as in the budget", positive=True)
    iterations: int | None = param(None, "most iterations; null: as the budget allows", positive=True)
    limit: float = param(1e3, "a search has diverged at a cost above this many times |J0| + 1", positive=True)
    quality: str = param("start", "where the gradient's quality is measured", choices=("none", "start"))

    def compares(self, parts: Mapping[str, Plugin | None]) -> bool:
        return self.quality != "none" and parts.get("estimator") is not None
