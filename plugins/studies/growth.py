"""How gradients grow with the horizon: their norm, the product of the step Jacobians, and the variance.

Shown are the curve that the norms of gradients follow, and from where on the zeroth order varies less.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.columns import COMMON, Column, Columns, ComparisonRule, bounded, interval, numbers, setting, text
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.views import Chart, Table, Views
from bench.measure.statistics import ends
from bench.model import Rollout, columns, param

from . import PARTS, StudyPackage, all_noise, finite_status, mean_interval, norm

if TYPE_CHECKING:
    import pandas as pd

ROUNDING = 1e-6
"""Rounding error of the log of a product's spectral radius, above sqrt(eps), the error at a defective eigenvalue; and
of the log of a norm that a curve describes exactly."""
STRONG = 20.0
"""Ratio of likelihoods from which one curve beats the other. By it, at most 5% of noisy power laws count as exploding."""
FEWEST = 5
"""Fewest horizons that decide between the curves: with four, 8% of noisy power laws count as exploding."""

QUANTILES = {"low": 0.05, "quarter": 0.25, "median": 0.5, "three_quarters": 0.75, "high": 0.95}
"""Quantiles over noise samples, stored for heavy-tailed quantities."""
ORDERS = {"first_order": "first-order", "zeroth_order": "zeroth-order"}
RATES = {"stretch": "largest singular value", "spectral": "spectral radius"}
MEDIAN: dict[str, Any] = {
    "label": "norm of one gradient",
    "low": "gradient_low",
    "high": "gradient_high",
    "ends": "5% to 95% of the noise samples",
}
MEANING = {
    "exploding": "explodes",
    "polynomial": "grows as a power",
    "growing": "grows, the law is open",
    "vanishing": "vanishes",
    "open": "open whether it grows",
}
"""What a verdict says of a curve."""
VERDICT = (
    text("problem"),
    text("verdict", "what the norms do along the horizon"),
    interval("order", "order of the best power law"),
    interval("rate", "rate of the best exponential", "1/s"),
    Column("odds", "likelihood of the exponential relative to the power law", label="exponential to power law"),
    text("lower", "the order whose variance is lower beyond doubt", label="lower variance"),
    setting("zeroth_from", "horizon from which on that is the zeroth order", "s", label="from"),
)
"""The columns of the table with a line per problem."""
VERDICT_NOTE = (
    "Median norms of one sample's gradient against the horizon, fitted by a power law and by an exponential. exploding: the "
    "exponential is at least 20 times as likely as the power law, and its rate is above 0. polynomial: the power law is as "
    "much more likely, or the more likely one where the Jacobian product does not grow, and its order is above 0. "
    "growing: each norm is certainly above the one before, and the curve is open. vanishing: the better curve falls by as much "
    "evidence. open: none of these. Intervals are of 95%. A variance is lower where the ranges over "
    "repeats from 5% to 95% do not overlap: first at every horizon, zeroth from a horizon on, else open."
)
NOTE = (
    "norm of one gradient: median and 5% to 95% of the noise samples. stretch, spectral: log of the largest singular value "
    "and of the spectral radius of the Jacobian product dx_N/dx_0, per second, mean and 95% interval. Jacobian product: "
    "exploding if the spectral radius certainly grows, vanishing if the stretch certainly falls. variance: per sample, median."
)


@dataclass(frozen=True)
class Growth(StudyPackage):
    """Measures norms of sampled gradients, products of step Jacobians, and variances of first- and zeroth-order terms."""

    name = "growth"
    columns = Columns.of(
        setting("time_horizon", "duration of the rollout", "s", label="horizon"),
        *(
            Column(
                f"gradient_{name}", f"norm of one sample's gradient, {q:.0%} quantile", **(MEDIAN if q == 0.5 else {})
            )
            for name, q in QUANTILES.items()
        ),
        Column("gradient_mean", "norm of the mean gradient"),
        Column("finite_fraction", "share of rollouts whose cost and gradient are finite"),
        *(
            column
            for name, what in RATES.items()
            for column in bounded(
                f"{name}_rate",
                f"log of the {what} of dx_N/dx_0, per step",
                stem=name,
                label=name,
                comparison=ComparisonRule("interval", "growth rate", neutral=True) if name == "stretch" else None,
            )
        ),
        *(
            column
            for order, name in ORDERS.items()
            for column in bounded(
                f"{order}_variance",
                f"variance of one {name} term, median over repeats",
                of="the range of 5% to 95% of the repeats",
                label=f"variance, {name}",
            )
        ),
        *(
            Column(f"{order}_variance_mean", f"variance of one {name} term, mean over repeats")
            for order, name in ORDERS.items()
        ),
        text("growth", "class of the Jacobian product: exploding, neutral or vanishing", label="Jacobian product"),
        numbers("singular_values", "singular values of dx_N/dx_0, median over rollouts", label="singular values"),
    )

    rollouts: int = param(
        64, "rollouts whose step Jacobians are multiplied: rates are known to 1/8 of their spread", low=2
    )

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column.

        They are gradient norms and variances of both orders over all samples, and Jacobian products of the study's first
        finite rollouts.
        """
        problem = session.problem(cell)
        program, theta = problem.program, problem.program.theta0
        w = columns(all_noise(cell, program))
        first, centre = problem.grad(theta, w), problem.value(theta, np.zeros((w.shape[0], 1)))
        zeroth = (problem.value(theta, w) - centre) * problem.score(theta, w)
        good = np.isfinite(first).all(axis=0) & np.isfinite(zeroth).all(axis=0)
        result: dict[str, Any] = {
            **finite_status(f"{(~good).sum()} of {good.size} rollouts or gradients are not finite", first, zeroth),
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
            found = np.median(totals), *np.quantile(totals, [QUANTILES["low"], QUANTILES["high"]])
            result |= ends(f"{order}_variance", map(float, found)) | {f"{order}_variance_mean": float(totals.mean())}
        steps = problem.jacobians(theta, w[:, good][:, : self.rollouts]).a
        singular, spectral = products(steps)
        rates = {"stretch": rate(singular[:, 0], len(steps)), "spectral": rate(spectral, len(steps))}
        return result | {
            **{
                f"{name}_{end}": value
                for name, found in rates.items()
                for end, value in zip(("rate", "low", "high"), found, strict=True)
            },
            "growth": classify(rates["stretch"][2], rates["spectral"][1], ROUNDING / len(steps)),
            "singular_values": np.exp(np.median(singular, axis=0)).tolist(),
        }

    def show(self, experiment: Experiment, rows: pd.DataFrame) -> Views:
        """Return a table with a line per problem and one with a line per cell, and the charts."""
        import pandas as pd

        from bench.report.shown import Shown

        shown = Shown(experiment, rows, along=["horizon"], method=(), problem=PARTS)
        per_second = {
            f"{name}_{end}": shown.rows[f"{name}_{end}"] / shown.rows["dt"]
            for name in RATES
            for end in ("rate", "low", "high")
        }
        columns = [
            COMMON["horizon"],
            shown.column("time_horizon"),
            shown.column("gradient_median"),
            *(shown.column(f"{name}_rate", unit="1/s") for name in RATES),
            shown.column("growth"),
            *(shown.column(f"{order}_variance", low="", high="") for order in ORDERS),
        ]
        cells = shown.cells(
            columns,
            "growth of gradients with the horizon",
            [NOTE],
            ("scene", "contact"),
            shown.rows.assign(**per_second),
            terminal=False,
        )
        good = shown.rows[np.isfinite(shown.rows["gradient_median"]) & (shown.rows["gradient_median"] > 0)]
        if good.empty:
            return Views([cells])
        lines = pd.DataFrame([verdict(part) for _, part in good.groupby("problem", sort=False)])
        answers = Table(
            "growth_verdicts", lines, VERDICT, "Growth of the gradient", [VERDICT_NOTE], terminal=True, page=True
        )
        chart = Chart(
            "growth",
            good,
            [shown.column("time_horizon", log=True)],
            [shown.column("gradient_median", log=True)],
            panel="problem",
            across=5,
            band=True,
            panel_notes=dict(zip(lines["problem"], lines["verdict"].map(MEANING), strict=True)),
            subtitle="median over noise samples; on these axes a power law is straight and an exponential bends upwards",
        )
        named = shown.arranged.rows.assign(problem=shown.rows["problem"]).fillna({"problem": ""})
        return Views([answers, cells], [chart], named)


# ------------------------------------------------------------------------------------------------ products


def products(steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return logarithms of the singular values ``(B, n)`` and spectral radii ``(B,)`` of dx_N/dx_0, -inf where it is singular.

    The products of the Jacobians ``(N, n, n, B)`` are normalised at each step, since they would overflow.
    """
    n, batch = steps.shape[2:]
    product, scale = np.broadcast_to(np.eye(n), (batch, n, n)), np.zeros(batch)
    with np.errstate(divide="ignore"):
        for a in np.moveaxis(steps, -1, 1)[::-1]:
            product = product @ a
            size = np.linalg.norm(product, axis=(1, 2))
            # a zero product stays zero and adds nothing to the scale
            size = np.where(size > 0, size, 1.0)
            product, scale = product / size[:, None, None], scale + np.log(size)
        singular = scale[:, None] + np.log(np.linalg.svd(product, compute_uv=False))
        return singular, scale + np.log(np.abs(np.linalg.eigvals(product)).max(axis=1))


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


# ------------------------------------------------------------------------------------------------ verdicts


def verdict(rows: pd.DataFrame) -> dict[str, Any]:
    """Return the line of one problem: the curves through its norms, the verdict, and where variances cross."""
    rows = rows.sort_values("time_horizon", kind="stable")
    counts = rows["samples"] * rows["repeats"] * rows["finite_fraction"]
    spread = np.log(rows["gradient_three_quarters"] / rows["gradient_quarter"])
    # standard error of a normal median: 1.2533 sigma / sqrt(n), and sigma is the interquartile range / 1.349
    errors = (1.2533 / 1.349 * spread / np.sqrt(counts)).fillna(0.0).to_numpy(float)
    horizons, norms = (rows[name].to_numpy(float) for name in ("time_horizon", "gradient_median"))
    fitted = fit(horizons, norms, errors, bounded=rows["growth"].iloc[-1] in ("neutral", "vanishing"))
    zeroth = (rows["zeroth_order_variance_high"] < rows["first_order_variance_low"]).to_numpy()
    is_first = (rows["first_order_variance_high"] < rows["zeroth_order_variance_low"]).all()
    # the first of the longest horizons at all of which the zeroth order varies less
    start = horizons[np.logical_and.accumulate(zeroth[::-1])[::-1]].min(initial=math.inf)
    lower = "zeroth" if math.isfinite(start) else "first" if is_first else "open"
    return {
        "problem": rows["problem"].iloc[0],
        **fitted,
        "lower": lower,
        "zeroth_from": start if lower == "zeroth" else math.nan,
    }


def fit(horizons: np.ndarray, norms: np.ndarray, errors: np.ndarray, bounded: bool = False) -> dict[str, Any]:
    """Fit a power law and an exponential to norms ``(n,)``; return the verdict on which they follow, ``odds`` and slopes.

    ``errors`` are the standard errors of the norms' logarithms. ``bounded`` states that the Jacobian product does not
    grow, which leaves the power law if the norms do not contradict it. The ratio of likelihoods of two least-squares fits
    with equally many parameters is (residual_1 / residual_2)^(n/2).
    """
    places, logarithms, errors = (np.log(horizons), horizons), np.log(norms), np.maximum(errors, ROUNDING)
    (*order, power), (*rate, exponential) = (_slope(at, logarithms, errors) for at in places)
    count, rises = len(norms), np.diff(logarithms) > 1.96 * np.hypot(errors[:-1], errors[1:])
    odds = (power / exponential) ** (count / 2) if count >= FEWEST else math.nan
    verdict = "open"
    if odds >= STRONG and rate[1] > 0:
        verdict = "exploding"
    elif (odds >= STRONG and rate[2] < 0) or (odds <= 1 / STRONG and order[2] < 0):
        verdict = "vanishing"
    elif order[1] > 0 and (odds <= 1 / STRONG or (odds <= 1 and bounded)):
        verdict = "polynomial"
    elif count > 2 and rises.all() and (np.diff(horizons) > 0).all():
        verdict = "growing"
    return {"verdict": verdict, "odds": odds, **ends("order", order), **ends("rate", rate)}


def _slope(places: np.ndarray, logarithms: np.ndarray, errors: np.ndarray) -> tuple[float, ...]:
    """Return the slope of a line with its 95% interval (Student's t), and the sum of squared residuals and errors."""
    from scipy.special import stdtrit

    count = len(places)
    if count < 3 or np.ptp(places) == 0:
        return (math.nan,) * 4
    away = places - places.mean()
    slope = float(away @ logarithms / (away @ away))
    start = float(logarithms.mean() - slope * places.mean())
    left = logarithms - start - slope * places
    residual = float(left @ left + errors @ errors)
    reach = float(stdtrit(count - 2, 0.975)) * math.sqrt(residual / (count - 2) / float(away @ away))
    return slope, slope - reach, slope + reach, residual
