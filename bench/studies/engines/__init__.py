"""Compares the gradients of physics engines: program and model error, bias, variance, time, memory and failures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, text
from bench.model import param
from bench.studies import StudyPackage


@dataclass(frozen=True)
class Engines(StudyPackage):
    """Measures whether an engine's gradient is right, its bias and variance, and what it costs."""

    name = "engines"
    axes = ("scene", "contact", "integrator", "backend")
    timed = True
    columns: ClassVar[Columns] = Columns.of(
        Column("program_error_rel", "distance of the gradient from its best central difference, relative to that difference",
               label="program error", comparison=ComparisonRule("exact", "program error")),
        Column("difference_step", "step of the best central difference, in the units of theta"),
        Column("model_error_rel", "distance of the gradient from the gradient named in `model`, relative to its norm",
               label="model error", comparison=ComparisonRule("exact", "model error")),
        text("model", "what model_error_rel compares with: rigid contact in closed form, or the scene's own program"),
        Column("reference_norm", "norm of the reference gradient of the engine's program"),
        Column("reference_se", "standard error of the reference gradient"),
        text("reference_method", "how the reference was computed"),
        Column("bias", "norm of the bias of `samples` averaged gradients, corrected for its own noise",
               comparison=ComparisonRule("interval", "bias")),
        Column("bias_low", "lower end of its 95% interval"),
        Column("bias_high", "upper end of its 95% interval"),
        Column("variance", "trace of the covariance of `samples` averaged gradients",
               comparison=ComparisonRule("spread", "variance")),
        Column("rmse_rel", "root mean squared error of `samples` averaged gradients / reference_norm", label="RMSE, gradients"),
        Column("zeroth_rmse_rel", "the same from `samples` costs with scores, without gradients", label="RMSE, costs only"),
        Column("nan_share", "share of the gradients that are not finite", label="NaN share"),
        Column("gradient_s", "time of `batch` gradients, median", "s", label="gradients", measured=True, format="seconds"),
        Column("value_s", "time of `batch` costs, median", "s", label="costs", measured=True, format="seconds"),
        Column("first_s", "time of the first gradients and costs, with starts and compilation", "s", label="first call",
               measured=True, format="seconds"),
        Column("pipe_share", "share of gradient_s outside the engine's process: pipes and copies", label="pipe", measured=True),
        Column("pass_share", "share of gradient_s in this process: costs, policy and adjoint pass", label="harness",
               measured=True),
        Column("memory_mb", "largest resident memory of the process that runs the engine", "MB", label="memory",
               measured=True),
        text("device", "device that computes, such as cpu or cuda:0"),
        text("engine_settings", "settings of an engine's process that can change its last digits: processors, environment "
             "variables, and its own, such as its determinism"),
        numbers("gradient", "gradient at theta without noise, by coordinate of theta",
                comparison=ComparisonRule("vector", "gradient")),
        numbers("model_gradient", "the gradient that model_error_rel compares with, by coordinate of theta"),
    )  # fmt: skip

    batch: int = param(64, "gradients in a timed call", positive=True)
    timed_calls: int = param(3, "timed calls", positive=True)
