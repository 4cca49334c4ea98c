"""The columns of the growth study."""

from typing import Any

from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, text
from bench.studies.growth.measure import QUANTILES

ORDERS = {"first_order": "first-order", "zeroth_order": "zeroth-order"}
SHOWN: dict[str, dict[str, Any]] = {
    "gradient_median": {"label": "norm of one gradient", "low": "gradient_low", "high": "gradient_high"},
    **{
        f"{order}_variance": {
            "label": f"variance, {name}", "low": f"{order}_variance_low", "high": f"{order}_variance_high"
        }
        for order, name in ORDERS.items()
    },
}  # fmt: skip
"""Label and range of the quantities that readers see, by column."""
COLUMNS = Columns.of(
    Column("time_horizon", "duration of the rollout", "s", label="horizon", format="setting"),
    *(
        Column(f"gradient_{name}", f"norm of one sample's gradient, {q:.0%} quantile", **SHOWN.get(f"gradient_{name}", {}))
        for name, q in QUANTILES.items()
    ),
    Column("gradient_mean", "norm of the mean gradient"),
    Column("finite_fraction", "share of rollouts whose cost and gradient are finite"),
    Column("stretch_rate", "log of the largest singular value of dx_N/dx_0, per step",
           label="stretch", low="stretch_low", high="stretch_high",
           comparison=ComparisonRule("interval", "growth rate", neutral=True)),
    Column("stretch_low", "lower end of its 95% interval"),
    Column("stretch_high", "upper end of its 95% interval"),
    Column("spectral_rate", "log of the spectral radius of dx_N/dx_0, per step",
           label="spectral", low="spectral_low", high="spectral_high"),
    Column("spectral_low", "lower end of its 95% interval"),
    Column("spectral_high", "upper end of its 95% interval"),
    *(
        Column(f"{order}_variance{end}", f"variance of one {name} term, {what}", **SHOWN.get(f"{order}_variance{end}", {}))
        for order, name in ORDERS.items()
        for end, what in (("", "median over repeats"), ("_low", "5% quantile"), ("_high", "95% quantile"))
    ),
    Column("first_order_variance_mean", "variance of one first-order term, mean over repeats"),
    Column("zeroth_order_variance_mean", "variance of one zeroth-order term, mean over repeats"),
    text("growth", "class of the Jacobian product: exploding, neutral or vanishing", label="Jacobian product"),
    text("gain_of", "inputs of the gain: controls or states"),
    numbers("lags", "steps between an input and the end of the rollout", "steps"),
    numbers("gain", "largest singular value of the derivative of the end state by an input, per lag, median over rollouts"),
    numbers("gain_low", "5% quantile of the gain over rollouts"),
    numbers("gain_high", "95% quantile of the gain over rollouts"),
    numbers("singular_values", "singular values of dx_N/dx_0, median over rollouts", label="singular values"),
)  # fmt: skip
