"""The columns of the main table, which users' scripts rely on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bench.experiment.columns import DRAWS, Column, Columns, ComparisonRule, bounded, interval, numbers, seconds, text
from bench.measure import statistics

if TYPE_CHECKING:
    import pandas as pd


def rmse(rows: pd.DataFrame) -> Any:
    """Return the root mean squared error of each row."""
    return statistics.rmse(rows["bias"], rows["variance"])


def rmse_rel(rows: pd.DataFrame) -> Any:
    """Return the relative RMSE of each row; NaN where the reference is not distinguishable from 0."""
    return (rmse(rows) / rows["reference_norm"]).where(rows["rmse_rel"].notna())


def rmse_start(rows: pd.DataFrame) -> Any:
    """Return the RMSE of each row in units of the gradient at the start of its descent; NaN without a descent."""
    return rmse(rows) / rows["start_norm"].where(rows["start_norm"] > 0)


TABLE = (
    "experiment",
    "scene",
    "contact",
    "integrator",
    "backend",
    "estimator",
    "estimator_params",
    "noise",
    "horizon",
    "dt",
    "stiffness",
    "sigma",
    "smoothing",
    "draws",
    "mirrored",
    "descent",
    "samples",
    "repeats",
    "dim",
    "seed",
    "status",
    "reason",
    "grad_norm",
    "reference_norm",
    "reference_method",
    "reference_se",
    "bias",
    "bias_low",
    "bias_high",
    "bias_rel",
    "variance",
    "variance_per_sample",
    "rmse",
    "rmse_rel",
    "start_norm",
    "rmse_start",
    "cosine",
    "sign_agreement",
    "finite_fraction",
    "model_error",
    "time_s",
    "time_iqr_s",
    "compile_s",
    "rollouts",
    "gradients",
    "peak_memory_mb",
    "dtype",
    "device",
    "versions",
    "key",
)
COLUMNS = Columns.ordered(
    TABLE,
    *DRAWS,
    Column("grad_norm", "norm of the mean estimate"),
    Column("reference_norm", "norm of the reference gradient"),
    text("reference_method", "how the reference was computed: closed_form, quadrature or sampling, with its settings"),
    Column("reference_se", "standard error of the reference, as the root of the trace of its covariance"),
    interval("bias", "norm of the bias, corrected for its own noise", comparison=ComparisonRule("interval", "bias")),
    Column("bias_low", "lower end of its 95% interval; 0 where the bias is not distinguishable from 0"),
    Column("bias_high", "upper end of its 95% interval"),
    Column("bias_rel", "bias / reference_norm"),
    *bounded(
        "variance",
        "trace of the covariance of one estimate",
        has_csv=False,
        comparison=ComparisonRule("spread", "variance"),
    ),
    *bounded(
        "variance_per_sample",
        "variance of one sample's term, from all terms where an estimate is a mean of terms, else samples * variance",
        has_csv=False,
    ),
    Column(
        "rmse",
        "root mean squared error of one estimate: root of variance + bias^2",
        derived=rmse,
        comparison=ComparisonRule(
            "paired", "RMSE", mean="mean_estimate", variance="variance", reference="reference_gradient"
        ),
    ),
    Column(
        "rmse_rel",
        "rmse / reference_norm; above 1 an estimate is worse than the zero estimate",
        label="relative RMSE",
        derived=rmse_rel,
    ),
    Column(
        "start_norm",
        "norm of the gradient at the start of the descent, of the program that is descended: the same for all cells of a "
        "scene, horizon and sigma; empty where descent is 0",
    ),
    Column(
        "rmse_start",
        "rmse / start_norm: the error in units of the gradient with which the descent began",
        derived=rmse_start,
        label="RMSE / start gradient",
    ),
    Column("cosine", "mean cosine between one estimate and the reference"),
    Column("sign_agreement", "share of coordinates of one estimate whose sign is the reference's"),
    Column("finite_fraction", "share of repeats that are finite"),
    Column("model_error", "norm of (program's gradient - physics' gradient) at w = 0"),
    seconds(
        "time_s",
        "one estimate of N samples without drawing noise, steady state, median over calls",
        "time",
        comparison=ComparisonRule("time", "time"),
    ),
    Column("time_iqr_s", "interquartile range over calls", "s", measured=True),
    seconds("compile_s", "time of compiling programs of the estimates, in the row of the cell that compiled them"),
    Column("rollouts", "costs evaluated for one estimate"),
    Column("gradients", "gradients evaluated for one estimate"),
    Column("peak_memory_mb", "largest resident memory of the process, libraries included", "MB", measured=True),
    text("device", "device that the program ran on"),
    Column("noise_s", "drawing the noise of one estimate, which time_s excludes", "s", table=False, measured=True),
    numbers("time_samples", "seconds of each call", "s", table=False, measured=True),
    Column("estimates_s", "seconds of all estimates together", "s", table=False, measured=True),
    Column("compilations", "number of programs compiled for the cell", table=False, measured=True),
    text("shapes", "hashes of the requested programs", table=False, measured=True),
    numbers("point", "theta at which the gradient is taken, by coordinate", table=False),
    text(
        "descent_path",
        "the descent: JSON of lists of share, norm of theta, cost, gradient norm, largest speed and largest move",
        table=False,
    ),
    *bounded(
        "cost",
        "mean cost of the rollouts of the first estimate, where the estimator uses costs",
        table=False,
        has_csv=False,
        of="the range of 95% of these costs",
    ),
    numbers("mean_estimate", "mean estimate, signed, by coordinate of theta", table=False),
    Column(
        "reference_spacing",
        "average spacing of the points of a reference by quadrature, in standard deviations of the noise",
        table=False,
    ),
    numbers("reference_gradient", "reference gradient, signed, by coordinate of theta", table=False),
    text(
        "auxiliaries",
        "diagnostics that the estimator reports, such as a weight: JSON of mean, quantiles and share of exact zeros",
        table=False,
    ),
)
