"""How gradients grow with the horizon: their norm, the product of the step Jacobians, and the variance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, text
from bench.experiment.session import Session
from bench.measure import noise
from bench.model import Jacobians, Problem, Rollout, columns, param

from .. import StudyPackage, mean_interval, norm

ROUNDING = 1e-6
"""Rounding error of the log of a product's spectral radius: above sqrt(eps), the error at a defective eigenvalue."""


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

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column.

        They are gradient norms and variances of both orders over all samples, and Jacobian products of the study's first
        finite rollouts.
        """
        problem = session.problem(cell)
        program, theta = problem.program, problem.program.theta0
        w = columns(noise.shared(cell.seed, cell.scene.name, cell.repeats, cell.samples, program.n_noise))
        first, centre = problem.grad(theta, w), problem.value(theta, np.zeros((w.shape[0], 1)))
        zeroth = (problem.value(theta, w) - centre) * problem.score(theta, w)
        good = np.isfinite(first).all(axis=0) & np.isfinite(zeroth).all(axis=0)
        result: dict[str, Any] = {
            "status": "ok" if good.all() else "nonfinite",
            "reason": "" if good.all() else f"{(~good).sum()} of {good.size} rollouts or gradients are not finite",
            "finite_fraction": float(good.mean()),
            "time_horizon": program.scene.horizon * program.scene.dt if isinstance(program, Rollout) else math.nan,
        }
        if not good.any():
            return result
        norms = np.linalg.norm(first[:, good], axis=0)
        result |= {f"gradient_{name}": float(np.quantile(norms, q)) for name, q in QUANTILES.items()}
        result["gradient_mean"] = norm(first[:, good].mean(axis=1))
        for order, terms in zip(ORDERS, (first, zeroth), strict=True):
            terms = np.where(good, terms, math.nan).reshape(len(theta), cell.repeats, cell.samples)
            with np.errstate(over="ignore"):
                totals = np.nansum(np.nanvar(terms, axis=2, ddof=1), axis=0)
            found = (np.median(totals), *np.quantile(totals, [QUANTILES["low"], QUANTILES["high"]]), totals.mean())
            ends = zip(("", "_low", "_high", "_mean"), map(float, found), strict=True)
            result |= {f"{order}_variance{end}": value for end, value in ends}
        return result | _product_columns(problem, w[:, good][:, : self.rollouts], self.lags)


# ------------------------------------------------------------------------------------------------ products


@dataclass(frozen=True)
class Products:
    """Logarithms of the Jacobian products of B rollouts; the products themselves would overflow."""

    gain: np.ndarray
    """log of the largest singular value of dx_N/du_i (of dx_N/dx_i without controls), ``(N, B)``, row N - 1 - i."""
    singular: np.ndarray
    """log of the singular values of dx_N/dx_0, ``(B, n)``; -inf where the product is singular."""
    spectral: np.ndarray
    """log of the spectral radius of dx_N/dx_0, ``(B,)``."""


def products(jacobians: Jacobians) -> Products:
    """Return the products A_{N-1} ... A_{i+1} B_i for every i, by one backward scan that normalises at each step."""
    a, b = np.moveaxis(jacobians.a, -1, 1), np.moveaxis(jacobians.b, -1, 1)
    horizon, batch, n = a.shape[:3]
    product, scale, gain = np.broadcast_to(np.eye(n), (batch, n, n)), np.zeros(batch), np.empty((horizon, batch))
    with np.errstate(divide="ignore"):
        for i in range(horizon - 1, -1, -1):
            after = product @ a[i]
            effect = product @ b[i] if b.shape[-1] else after
            gain[horizon - 1 - i] = scale + np.log(np.linalg.norm(effect, ord=2, axis=(1, 2)))
            size = np.linalg.norm(after, axis=(1, 2))
            # a zero product stays zero and adds nothing to the scale
            size = np.where(size > 0, size, 1.0)
            product, scale = after / size[:, None, None], scale + np.log(size)
        singular = scale[:, None] + np.log(np.linalg.svd(product, compute_uv=False))
        return Products(gain, singular, scale + np.log(np.abs(np.linalg.eigvals(product)).max(axis=1)))


def rate(logarithms: np.ndarray, steps: int) -> tuple[float, float, float]:
    """Return log |product| ``(B,)`` per step, averaged over noise samples, with its 95% interval (Student's t)."""
    rates = logarithms[np.isfinite(logarithms)] / steps
    if rates.size < 2:
        return math.nan, -math.inf, math.inf
    return mean_interval(rates)


def classify(stretch_high: float, spectral_low: float, tolerance: float) -> str:
    """Return ``exploding`` if the spectral radius certainly grows, ``vanishing`` if the norm certainly falls, else ``neutral``.

    The spectral radius never exceeds the norm and does not depend on the units of the state. By its norm, a free mass
    would count as exploding, although its product [[1, t], [0, 1]] grows only like t and has spectral radius 1.
    """
    if spectral_low > tolerance:
        return "exploding"
    return "vanishing" if stretch_high < -tolerance else "neutral"


def _product_columns(problem: Problem, w: np.ndarray, most_lags: int) -> dict[str, Any]:
    """Return the columns of the Jacobian product for noise ``w (n_w, B)``: gains, singular values, rates and class."""
    jacobians = problem.jacobians(problem.program.theta0, w)
    steps = jacobians.a.shape[0]
    product = products(jacobians)
    lags = np.unique(np.round(np.geomspace(1, steps, most_lags)).astype(int))
    gains = np.exp(np.quantile(product.gain[lags - 1], [0.05, 0.5, 0.95], axis=1)).tolist()
    rates = {"stretch": rate(product.singular[:, 0], steps), "spectral": rate(product.spectral, steps)}
    return {
        **{f"{name}_{end}": value for name, found in rates.items() for end, value in zip(("rate", "low", "high"), found, strict=True)},
        "growth": classify(rates["stretch"][2], rates["spectral"][1], ROUNDING / steps),
        "gain_of": "controls" if jacobians.b.shape[2] else "states",
        "lags": lags.tolist(), **dict(zip(("gain_low", "gain", "gain_high"), gains, strict=True)),
        "singular_values": np.exp(np.median(product.singular, axis=0)).tolist(),
    }  # fmt: skip
