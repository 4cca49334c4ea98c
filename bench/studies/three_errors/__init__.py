"""Measures program, model and estimator error of a gradient separately, and the forward error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, text
from bench.studies import StudyPackage


@dataclass(frozen=True)
class ThreeErrors(StudyPackage):
    """Measures program, model and estimator error of a gradient, and the forward error."""

    name = "three_errors"
    columns: ClassVar[Columns] = Columns.of(
        Column("cost", "cost f at theta, without noise"),
        Column("physical_cost", "cost of the physics at theta, without noise"),
        Column("forward_error", "difference of cost and physical_cost"),
        Column(
            "forward_error_rel",
            "forward_error relative to physical_cost",
            label="forward error",
            comparison=ComparisonRule("exact", "forward error"),
        ),
        Column("program_norm", "norm of the program's gradient"),
        Column("program_error", "norm of (program's gradient - its best central difference)"),
        Column(
            "program_error_rel",
            "program_error relative to the norm of that difference",
            label="program error",
            comparison=ComparisonRule("exact", "program error"),
        ),
        Column("difference_step", "step of the best central difference, in the units of theta"),
        Column("physical_norm", "norm of the physics' gradient"),
        Column("model_error", "norm of (program's gradient - physics' gradient)"),
        Column(
            "model_error_rel",
            "model_error relative to physical_norm",
            label="model error",
            comparison=ComparisonRule("exact", "model error"),
        ),
        Column(
            "model_cosine", "cosine between the program's gradient and the physics' gradient", label="cosine to physics"
        ),
        Column("model_signs", "share of coordinates in which both gradients have the same sign", label="right signs"),
        Column("reference_norm", "norm of the reference gradient of the program"),
        Column("reference_se", "standard error of the reference gradient"),
        Column(
            "bias",
            "norm of the estimator's bias, corrected for its own noise",
            comparison=ComparisonRule("interval", "bias"),
        ),
        Column("bias_low", "lower end of its 95% interval"),
        Column("bias_high", "upper end of its 95% interval"),
        Column("bias_rel", "bias / reference_norm", label="estimator error"),
        Column("variance", "trace of the covariance of one estimate", comparison=ComparisonRule("spread", "variance")),
        Column("rmse_rel", "root mean squared error of one estimate / reference_norm"),
        Column("cosine", "mean cosine between one estimate and the reference"),
        Column("sign_agreement", "share of coordinates of one estimate whose sign is the reference's"),
        text("reference_method", "how the reference was computed"),
        numbers("gradient", "the program's gradient, by coordinate of theta"),
        numbers("physical_gradient", "the physics' gradient, by coordinate of theta"),
    )
