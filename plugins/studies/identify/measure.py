"""Measures one cell: what fits of its records estimate, how certainly, and what they cannot notice."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import chdtri

from bench.errors import Unsupported
from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.host.parameters import parameters
from bench.measure import noise, performance
from bench.measure.statistics import ends
from bench.model import Program

from .. import norm
from . import Identify, adequacy
from .fitting import Fit, Fitting, count_windows, information, run_fits
from .information import Information, product
from .missing import missing_terms
from .model import Model, model_of, own_record
from .record import evaluate, expressions

NOISE = 0.01
"""Noise of records that are made from the truth, if none is stated."""
SHARE = 1e-4
"""Exponents below this are 0."""


def prepared(cell: Cell, settings: Identify) -> tuple[Model, np.ndarray | None]:
    """Return the cell's model and the user's own measurements ``(m, 1)``, or None if records are made from the truth.

    Raises ValueError, :class:`UserError` or OSError for settings or a file that cannot be used.
    """
    model = model_of(cell)
    for text in expressions(settings.terms).values():
        evaluate(text, dict.fromkeys((*model.entries, "q", "v", "t"), np.zeros(2)))
    return (model, None) if settings.record is None else own_record(settings.record, settings, model)


def measure(cell: Cell, session: Session, settings: Identify) -> dict[str, Any]:
    """Return one cell's results by column: fits of all records by each shooting method, and the Cramer-Rao bound.

    Raises :class:`Unsupported` if a record without a stated noise has no more measurements than parameters.
    """
    optimizer: Any = cell.parts["optimizer"]
    model, measurements = prepared(cell, settings)
    is_own, data = measurements is not None, records(cell, settings) if measurements is None else measurements
    factor = np.where(np.arange(data.shape[1]) % 2 == 0, settings.start, 1.0 / settings.start)
    theta, start = model.values, model.values[:, None] * factor
    if cell.decision.at is not None:
        start[: len(cell.decision.at)] = np.array(cell.decision.at)[:, None]
    horizon = model.program.scene.horizon
    n_windows = count_windows(horizon, settings.windows)
    has_windows = len(model.steps) == horizon and n_windows > 1

    is_noise_known = settings.measurement is not None or not is_own

    def fit(shooting: str, sigma: float) -> Fit:
        """Fit by one rollout (``single``), windows joined by a penalty on gaps (``multiple``), or independent ``windows``."""
        fitting = Fitting(model, shooting, 1 if shooting == "single" else n_windows, sigma)
        fitted = run_fits(fitting, optimizer, fitting.start(start, data), data, settings.iterations)
        return Fit(
            fitting, is_noise_known, *fitted, fitting.residuals(fitted[0], data), fitting.jacobians(fitted[0], data)
        )

    sigma = settings.measurement or (float(np.std(data)) or 1.0 if is_own else NOISE)
    if is_own:
        first, free = fit("single", sigma), len(data) - len(theta)
        if not is_noise_known:
            if free < 1:
                raise Unsupported(
                    f"{settings.record} has {len(data)} measurements for {len(theta)} unknowns: state the noise, measurement=.."
                )
            sigma *= norm(first.residual) / math.sqrt(free) or 1.0
        theta = model.theta(first.solution)[:, 0]
        model = model.scaled(theta)
    single = fit("single", sigma)
    known = information(model, theta, sigma)
    result: dict[str, Any] = {
        "status": "ok",
        "reason": "",
        "rank": known.rank,
        "condition": known.condition,
        "fits": data.shape[1],
        "unknowns": list(model.names),
        "truth": [math.nan] * len(theta) if is_own else theta.tolist(),
        "invariants": known.labels,
        "bound": known.bound.tolist(),
        **step_dependence(cell, model, theta, known, sigma),
        **_estimates(single, known, start[:, 0], expressions(settings.terms)),
    }
    fits = [single, *(fit(shooting, sigma) for shooting in ("multiple", "windows") if has_windows)]
    result |= pd.DataFrame([_fit_statistics(one, known, is_own) for one in fits]).to_dict("list")
    return result


@dataclass(frozen=True)
class _Intervals:
    """Estimates of the invariants from the first record and their 95% intervals, each ``(rank,)``."""

    estimate: np.ndarray
    size: np.ndarray
    """The error of an estimate per error of its coordinate."""
    half: np.ndarray
    """Half the widths of the intervals of the coordinates."""
    low: np.ndarray
    high: np.ndarray
    noise: str
    """The noise that the intervals allow for."""


def _intervals(fit: Fit, known: Information, theta: np.ndarray) -> _Intervals:
    """Return the intervals for estimates ``theta (p,)`` of the parameters."""
    scale, invariants = fit.fitting.model.scale, known.invariants
    estimate, (half, kind) = _products(theta, invariants), _half_widths(fit, 0, known)
    size = np.abs(_products(np.where(scale, scale, theta), invariants))
    # an unknown without a logarithm has an interval of its own values
    is_linear = np.abs(invariants) @ (scale != 0.0) > SHARE
    with np.errstate(over="ignore", invalid="ignore"):
        low, high = (
            np.where(is_linear, estimate + side * size * half, estimate * np.exp(side * half)) for side in (-1.0, 1.0)
        )
    return _Intervals(estimate, size, half, low, high, kind)


def _units(program: Program, names: tuple[str, ...]) -> dict[str, str]:
    """Return the units of unknowns; empty for entries of the initial state, which follow the parameters."""
    units = [parameters(type(program.parts[axis]))[name].unit or "1" for axis, name in program.named]
    return dict(itertools.zip_longest(names, units, fillvalue=""))


def _estimates(fit: Fit, known: Information, start: np.ndarray, own: Mapping[str, str]) -> dict[str, Any]:
    """Return the first record's estimates, whether fits explain the records, and the biases that tests can miss.

    ``explained`` is the share of records that no test contradicts. The other columns belong to the first record.
    """
    model, p = fit.fitting.model, len(known.names)
    theta = model.theta(fit.solution[:p, :1])[:, 0]
    intervals = _intervals(fit, known, theta)
    result = _parameters(model, known, intervals, start)
    # the residuals of at most so many records are tested
    tested = np.flatnonzero(fit.is_finite)[:64].tolist()
    if 0 not in tested:
        return result
    # the effects of missing terms at one fit serve all records, which have the same truth
    terms = missing_terms(model, theta, fit.fitting.noise, own)
    channels = len(model.measured)
    first, *others = (
        adequacy.judge(fit.residual[:, i], known.along(fit.slopes(i)), channels, terms, i, fit.is_noise_known)
        for i in tested
    )
    is_untested = math.isnan(first.probability)
    free = max(len(fit.residual) - known.rank, 1)
    result |= {
        "explained": math.nan if is_untested else float(np.mean([one.is_explained for one in (first, *others)])),
        "contradictions": ", ".join(f"{name} ({value:.2g})" for name, value in first.contradictions.items()),
        "noise_size": fit.fitting.noise * norm(fit.residual[:, 0]) / math.sqrt(free),
    }
    return result | _unnoticed(fit, known, intervals, terms, first.reach) if first.reach else result


def _parameters(model: Model, known: Information, intervals: _Intervals, start: np.ndarray) -> dict[str, Any]:
    """Return the columns of the invariants, then of the parameters that are none, without biases."""
    names = list(dict.fromkeys([*known.labels, *known.names]))
    others = np.eye(len(known.names))[[known.names.index(name) for name in names[known.rank :]]]
    exponents = np.concatenate([known.invariants, others])
    is_seen = (np.abs(exponents @ known.invariants.T) > SHARE).any(axis=1)
    units, nothing = _units(model.program, known.names), [math.nan] * len(others)
    factors = tuple(f"({unit})" if {*unit} & {*" /"} else unit or "1" for unit in units.values())
    return {
        "parameter": names,
        **ends("estimate", ([*part, *nothing] for part in (intervals.estimate, intervals.low, intervals.high))),
        "unit": [units.get(name, product(factors, row)) for name, row in zip(names, exponents, strict=True)],
        "start": _products(start, exponents).tolist(),
        "interval_noise": intervals.noise,
        "identifiable": ["yes" if k < known.rank else "product" if seen else "no" for k, seen in enumerate(is_seen)],
        "bias": [math.nan] * len(names),
        **{name: [] for name in ("biased", "term", "unnoticed", "errors")},
    }


def _unnoticed(
    fit: Fit, known: Information, intervals: _Intervals, terms: Mapping[str, np.ndarray], reach: Mapping[str, float]
) -> dict[str, Any]:
    """Return the columns of the biases by terms of a size, in ``reach``, that tests just miss."""
    biases = _hidden_biases(fit, known, np.array([terms[name] for name in reach]), [*reach.values()])
    unnoticed = biases * intervals.size[:, None]
    nothing = [math.nan] * (len({*known.labels, *known.names}) - known.rank)
    return {
        "bias": [*unnoticed.max(axis=1, initial=0.0), *nothing],
        "biased": np.repeat(known.labels, len(reach)).tolist(),
        "term": [*reach] * known.rank,
        "unnoticed": unnoticed.ravel().tolist(),
        "errors": (biases * performance.Z / intervals.half[:, None]).ravel().tolist(),
    }


def _hidden_biases(fit: Fit, known: Information, effects: np.ndarray, reach: list[float]) -> np.ndarray:
    """Return the change of the invariants' coordinates ``(rank, k)`` by ``effects (k, m)`` of a size that tests just miss."""
    shares = np.abs(np.linalg.pinv(known.along(fit.slopes(0))) @ effects.T) / known.bound[:, None]
    is_moved = shares > adequacy.RESOLVED * shares.max(axis=0, initial=0.0)
    with np.errstate(invalid="ignore"):  # an effect that is all in one estimate moves no other
        return known.bound[:, None] * np.where(is_moved, shares * reach, 0.0)


def _half_widths(fit: Fit, i: int, known: Information) -> tuple[np.ndarray, str]:
    """Return half the widths of fit ``i``'s 95% intervals of the invariants' coordinates, and the noise they allow for."""
    if not fit.is_finite[i] or Information(known.names, fit.slopes(i)).rank < known.rank:
        return np.full(known.rank, np.inf), ""
    slopes = known.along(fit.slopes(i))
    if fit.fitting.shooting != "single":
        return performance.Z * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes))), ""
    channels = len(fit.fitting.model.measured)
    variance, kind, quantile = adequacy.variances(fit.residual[:, i], slopes, channels, fit.is_noise_known)
    return quantile * np.sqrt(variance), kind


def _products(theta: np.ndarray, exponents: np.ndarray) -> np.ndarray:
    """Return products of powers ``(r,)`` of ``theta (p,)``, for exponents ``(r, p)``."""
    with np.errstate(all="ignore"):
        return np.prod(np.sign(theta) ** np.rint(exponents) * np.abs(theta) ** exponents, axis=1)


def _fit_statistics(fit: Fit, known: Information, is_own: bool) -> dict[str, Any]:
    """Return the entries of one shooting method."""
    p, n_fits, shooting, model = len(known.names), fit.solution.shape[1], fit.fitting.shooting, fit.fitting.model
    measured = len(model.steps) * len(model.measured)
    square = (fit.residual[:measured] ** 2).sum(axis=0)
    # gaps of multiple shooting tie its initial states to the parameters
    free = max(measured - (fit.fitting.dim if shooting == "windows" else p), 1)
    # only 0.1% of the fits to a right model have larger residuals
    has_converged = np.isfinite(square) & (square <= chdtri(free, 1e-3))
    hidden = sum(
        Information(known.names, fit.slopes(i)).rank > known.rank for i in np.flatnonzero(fit.is_finite).tolist()
    )
    halves = np.stack([_half_widths(fit, i, known)[0] for i in range(n_fits)], axis=1)
    chosen = has_converged & np.isfinite(halves).all(axis=0) & (not is_own)
    apart = known.invariants @ (fit.solution[:p] - model.points(model.values[:, None]))
    errors = (apart / known.bound[:, None])[:, chosen]
    is_covered = (np.abs(apart) <= halves)[:, chosen]
    n_converged, coverage, interval = int(has_converged.sum()), math.nan, (math.nan, math.nan)
    if is_covered.size:
        coverage = float(is_covered.mean())
        # the sample size of this interval is the number of records: invariants of one record are dependent
        interval = performance.wilson(round(coverage * n_converged), n_converged)
    return {
        "shooting": shooting,
        "optimum": float(fit.has_converged.mean()),
        **ends("converged", (n_converged / n_fits, *performance.wilson(n_converged, n_fits))),
        "error": float(np.sqrt(np.mean(np.square(errors)))) if errors.size else math.nan,
        **ends("coverage", (coverage, *interval)),
        "hidden": hidden,
    }


def records(cell: Cell, settings: Identify) -> np.ndarray:
    """Return ``repeats`` noisy records ``(m, B)`` of the true motion."""
    source = model_of(cell, settings.refine)
    clean = source.record(source.values[:, None])
    drawn = noise.draw(cell.seed, cell.scene.name, cell.repeats, 1, len(clean), "identify: measurements")[:, 0].T
    return clean + (settings.measurement or NOISE) * drawn


def step_dependence(cell: Cell, model: Model, theta: np.ndarray, known: Information, sigma: float) -> dict[str, float]:
    """Return the largest change of a noiseless fit when the model's step is halved: relative, and in units of its bound.

    To first order, it is the least-squares change of the parameters that compensates the change of the record.
    """
    steps = tuple(2 * step for step in model.steps)
    half = dataclasses.replace(model_of(cell, 2), measured=model.measured, steps=steps)
    change = (half.record(theta[:, None]) - model.record(theta[:, None]))[:, 0] / sigma
    if not known.rank or not np.isfinite(change).all():
        return {"step_shift": math.nan, "step_shift_bound": math.nan}
    shift = np.abs(np.linalg.pinv(known.along(known.jacobian)) @ change)
    return {"step_shift": float(shift.max()), "step_shift_bound": float((shift / known.bound).max())}
