"""Measures how gradients grow with the horizon: their norm, the product of the step Jacobians, and the variance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import noise
from bench.model import Jacobians, Problem, Rollout, columns

QUANTILES = {"low": 0.05, "quarter": 0.25, "median": 0.5, "three_quarters": 0.75, "high": 0.95}
"""Quantiles over noise samples, stored for heavy-tailed quantities."""
ROUNDING = 1e-6
"""Rounding error of the log of a product's spectral radius: above sqrt(eps), the error at a defective eigenvalue."""


def measure(cell: Cell, session: Session, rollouts: int, most_lags: int) -> dict[str, Any]:
    """Return one cell's results by column.

    They are gradient norms and variances of both orders over all samples, and Jacobian products of the first
    ``rollouts`` finite rollouts, with gains at ``most_lags`` lags at most.
    """
    problem = session.problem(cell)
    program = problem.program
    draws = noise.shared(cell.seed, cell.scene.name, cell.repeats, cell.samples, problem.program.n_noise)
    theta, w = program.theta0, columns(draws)
    first = problem.grad(theta, w)
    centre = problem.value(theta, np.zeros((w.shape[0], 1)))
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
    result["gradient_mean"] = float(np.linalg.norm(first[:, good].mean(axis=1)))
    for name, terms in (("first_order", first), ("zeroth_order", zeroth)):
        result |= variances(np.where(good, terms, math.nan).reshape(len(theta), cell.repeats, cell.samples), name)
    return result | _product_columns(problem, w[:, good][:, :rollouts], most_lags)


def variances(terms: np.ndarray, name: str) -> dict[str, float]:
    """Return the variance per sample of terms ``(d, R, N)``: median, 5% and 95% quantiles and mean over repeats R."""
    with np.errstate(over="ignore"):
        totals = np.nansum(np.nanvar(terms, axis=2, ddof=1), axis=0)
    return {
        f"{name}_variance": float(np.median(totals)),
        f"{name}_variance_low": float(np.quantile(totals, QUANTILES["low"])),
        f"{name}_variance_high": float(np.quantile(totals, QUANTILES["high"])),
        f"{name}_variance_mean": float(totals.mean()),
    }


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
    product = np.broadcast_to(np.eye(n), (batch, n, n))
    scale = np.zeros(batch)
    gain = np.empty((horizon, batch))
    for i in range(horizon - 1, -1, -1):
        after = product @ a[i]
        effect = product @ b[i] if b.shape[-1] else after
        gain[horizon - 1 - i] = scale + _log(np.linalg.norm(effect, ord=2, axis=(1, 2)))
        norm = np.linalg.norm(after, axis=(1, 2))
        # a zero product stays zero and adds nothing to the scale
        norm = np.where(norm > 0, norm, 1.0)
        product, scale = after / norm[:, None, None], scale + np.log(norm)
    singular = scale[:, None] + _log(np.linalg.svd(product, compute_uv=False))
    spectral = scale + _log(np.abs(np.linalg.eigvals(product)).max(axis=1))
    return Products(gain, singular, spectral)


def _log(values: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(values))


def rate(logarithms: np.ndarray, steps: int) -> tuple[float, float, float]:
    """Return log |product| ``(B,)`` per step, averaged over noise samples, with its 95% interval (Student's t)."""
    from scipy.special import stdtrit

    rates = logarithms[np.isfinite(logarithms)] / steps
    if rates.size < 2:
        return math.nan, -math.inf, math.inf
    reach = float(stdtrit(rates.size - 1, 0.975)) * float(rates.std(ddof=1)) / math.sqrt(rates.size)
    mean = float(rates.mean())
    return mean, mean - reach, mean + reach


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
    stretch, spectral = rate(product.singular[:, 0], steps), rate(product.spectral, steps)
    lags = np.unique(np.round(np.geomspace(1, steps, most_lags)).astype(int))
    low, middle, high = np.exp(np.quantile(product.gain[lags - 1], [0.05, 0.5, 0.95], axis=1))
    return {
        **dict(zip(("stretch_rate", "stretch_low", "stretch_high"), stretch, strict=True)),
        **dict(zip(("spectral_rate", "spectral_low", "spectral_high"), spectral, strict=True)),
        "growth": classify(stretch[2], spectral[1], ROUNDING / steps),
        "gain_of": "controls" if jacobians.b.shape[2] else "states",
        "lags": lags.tolist(),
        "gain": middle.tolist(),
        "gain_low": low.tolist(),
        "gain_high": high.tolist(),
        "singular_values": np.exp(np.median(product.singular, axis=0)).tolist(),
    }
