"""How gradients grow with the horizon: their norm, the product of the step Jacobians, and the variance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, text
from bench.model import param
from bench.studies import StudyPackage

QUANTILES = {"low": 0.05, "quarter": 0.25, "median": 0.5, "three_quarters": 0.75, "high": 0.95}
"""Quantiles over noise samples, stored for heavy-tailed quantities."""
ORDERS = {"first_order": "first-order", "zeroth_order": "zeroth-order"}
RATES = {"stretch": "largest singular value", "spectral": "spectral radius"}
MEDIAN: dict[str, Any] = {"label": "norm of one gradient", "low": "gradient_low", "high": "gradient_high"}
INTERVAL = {"low": "lower end of its 95% interval", "high": "upper end of its 95% interval"}


@dataclass(frozen=True)
class Growth(StudyPackage):
    """Measures norms of sampled gradients, products of step Jacobians, and variances of first- and zeroth-order terms."""

    name = "growth"
    columns: ClassVar[Columns] = Columns.of(
        Column("time_horizon", "duration of the rollout", "s", label="horizon", format="setting"),
        *(
            Column(f"gradient_{name}", f"norm of one sample's gradient, {q:.0%} quantile",
                   **(MEDIAN if q == 0.5 else {}))
            for name, q in QUANTILES.items()
        ),
        Column("gradient_mean", "norm of the mean gradient"),
        Column("finite_fraction", "share of rollouts whose cost and gradient are finite"),
        *(
            column
            for name, what in RATES.items()
            for column in (
                Column(f"{name}_rate", f"log of the {what} of dx_N/dx_0, per step", label=name, low=f"{name}_low",
                       high=f"{name}_high",
                       comparison=ComparisonRule("interval", "growth rate", neutral=True) if name == "stretch" else None),
                *(Column(f"{name}_{end}", doc) for end, doc in INTERVAL.items()),
            )
        ),
        *(
            Column(f"{order}_variance{end}", f"variance of one {name} term, {what}",
                   label="" if end else f"variance, {name}", low="" if end else f"{order}_variance_low",
                   high="" if end else f"{order}_variance_high")
            for order, name in ORDERS.items()
            for end, what in (("", "median over repeats"), ("_low", "5% quantile"), ("_high", "95% quantile"))
        ),
        *(Column(f"{order}_variance_mean", f"variance of one {name} term, mean over repeats") for order, name in ORDERS.items()),
        text("growth", "class of the Jacobian product: exploding, neutral or vanishing", label="Jacobian product"),
        text("gain_of", "inputs of the gain: controls or states"),
        numbers("lags", "steps between an input and the end of the rollout", "steps"),
        numbers("gain", "largest singular value of the derivative of the end state by an input, per lag, median over rollouts"),
        numbers("gain_low", "5% quantile of the gain over rollouts"),
        numbers("gain_high", "95% quantile of the gain over rollouts"),
        numbers("singular_values", "singular values of dx_N/dx_0, median over rollouts", label="singular values"),
    )  # fmt: skip

    rollouts: int = param(
        64, "rollouts whose step Jacobians are multiplied: rates are known to 1/8 of their spread", low=2
    )
    lags: int = param(40, "most lags whose gain is stored", positive=True)
