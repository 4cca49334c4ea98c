"""The columns of the three errors."""

from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, text

COLUMNS = Columns.of(
    Column("cost", "f at theta, without noise"),
    Column("physical_cost", "the same of the physics"),
    Column("forward_error", "their difference"),
    Column("forward_error_rel", "relative to the physics' cost", comparison=ComparisonRule("exact", "forward error")),
    Column("program_norm", "norm of the program's gradient"),
    Column("program_error", "norm of (program's gradient - its best central difference)"),
    Column("program_error_rel", "relative to the difference", comparison=ComparisonRule("exact", "program error")),
    Column("difference_step", "step of that difference, in the units of theta"),
    Column("physical_norm", "norm of the physics' gradient"),
    Column("model_error", "norm of (program's gradient - physics' gradient)"),
    Column("model_error_rel", "relative to the physics' gradient", comparison=ComparisonRule("exact", "model error")),
    Column("model_cosine", "cosine between the two"),
    Column("model_signs", "share of coordinates whose sign is the physics'"),
    Column("reference_norm", "norm of the reference gradient of the program"),
    Column("reference_se", "its standard error"),
    Column(
        "bias",
        "norm of the estimator's bias, corrected for its own noise",
        comparison=ComparisonRule("interval", "bias"),
    ),
    Column("bias_low", "lower end of its 95% interval"),
    Column("bias_high", "upper end of its 95% interval"),
    Column("bias_rel", "bias / reference_norm"),
    Column("variance", "trace of the covariance of one estimate", comparison=ComparisonRule("spread", "variance")),
    Column("rmse_rel", "root mean squared error of one estimate / reference_norm"),
    Column("cosine", "mean cosine between one estimate and the reference"),
    Column("sign_agreement", "share of coordinates of one estimate whose sign is the reference's"),
    text("reference_method", "how the reference was computed"),
    numbers("gradient", "the program's gradient, by coordinate of theta"),
    numbers("physical_gradient", "the physics' gradient, by coordinate of theta"),
)
