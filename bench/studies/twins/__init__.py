"""Compares a physics engine's twin of a scene with the scene's own program: one rollout, its cost and its gradient."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, text
from bench.model import param
from bench.studies import StudyPackage


@dataclass(frozen=True)
class Twins(StudyPackage):
    """Measures the difference between a physics engine's twin and the scene's own program, and the time of gradients."""

    name = "twins"
    timed: ClassVar[bool] = True
    columns: ClassVar[Columns] = Columns.of(
        Column("state_difference", "largest difference of states over time and coordinates", label="states"),
        Column("state_difference_rel", "largest difference of states, each coordinate in units of its largest value",
               label="states, relative",
               comparison=ComparisonRule("exact", "difference of states")),
        Column("cost", "cost of the twin"),
        Column("own_cost", "cost of the scene's own program"),
        Column("cost_difference_rel", "relative difference of the costs", label="cost, relative"),
        Column("gradient_norm", "norm of the twin's gradient"),
        Column("own_gradient_norm", "norm of the own program's gradient"),
        Column("gradient_difference_rel", "relative difference of the gradients", label="gradient, relative",
               comparison=ComparisonRule("exact", "difference of gradients")),
        Column("gradient_cosine", "cosine between the gradients", label="cosine"),
        Column("value_s", "time of the costs of `samples` rollouts", "s", measured=True, label="costs", format="seconds"),
        Column("gradient_s", "time of the gradients of `samples` rollouts", "s", measured=True, label="gradients", format="seconds"),
        Column("trace_s", "part of compile_s: tracing the Python code", "s", measured=True),
        Column("lower_s", "part of compile_s: lowering the trace to the compiler's input", "s", measured=True),
        Column("compile_s", "total time of compiling the gradient", "s", measured=True, label="compilation", format="seconds"),
        text("own_backend", "backend of the scene's own program"),
        numbers("gradient", "the twin's gradient, by coordinate of theta"),
        numbers("own_gradient", "the own program's gradient, by coordinate of theta"),
        numbers("path", "positions of the twin along the rollout", table=False),
        numbers("own_path", "positions of the own program along the rollout", table=False),
    )  # fmt: skip

    timed_calls: int = param(5, "calls timed for costs and for gradients", positive=True)
