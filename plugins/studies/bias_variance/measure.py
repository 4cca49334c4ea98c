"""Computes a cell's estimates. Noise too large for memory is drawn in parts.

An estimator that is a mean of terms is summed per repeat, part by part and in a fixed order. So memory does not grow
with samples or repeats, and the result is the same to the last digit for any number of threads and on any machine.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import noise, timing
from bench.measure.statistics import ends
from bench.measure.timing import Pause
from bench.model import IID, Auxiliaries, Problem, SampleMean, columns, per_repeat
from bench.model.estimator import require_shape

from .. import against_reference, all_noise
from . import BiasVariance

MOST_TERMS = 1 << 25
"""Most numbers in the terms of one call (256 MiB): d per sample. With more, fewer repeats or samples share a call."""


class CellEstimates:
    """The independent estimates of a cell, computed on request, and statistics of their single terms."""

    def __init__(self, cell: Cell, problem: Problem, theta: np.ndarray) -> None:
        self.pause = Pause()
        """Time [s] spent on drawing noise and on statistics, excluded from the time of an estimate."""
        self.diagnostics: dict[int, Auxiliaries] = {}
        """Diagnostics that the estimator reports, by the first repeat of the batch."""
        self._cell, self._problem, self._theta = cell, problem, theta
        self._width = problem.program.n_noise
        self._estimator = cell.estimator
        self.design = cell.design(problem.program)
        """How the noise of one estimate is drawn."""
        self._columns = max(1, MOST_TERMS // problem.dim)
        fits = cell.repeats * cell.samples * self._width <= noise.HELD
        self._noise = all_noise(cell, problem.program) if fits else None
        self._centre: np.ndarray | None = None
        self._terms: dict[int, tuple[Any, float]] = {}
        """Per repeat, the sum of (term - common centre), ``(d,)``, and the sum of its squared norms."""

    def of(self, start: int, stop: int) -> np.ndarray:
        """Return the estimates of repeats ``start`` to ``stop - 1``, ``(stop - start, d)``."""
        estimator, together = self._estimator, max(1, self._columns // self._cell.samples)
        if stop - start > together:
            return np.concatenate([self.of(r, min(r + together, stop)) for r in range(start, stop, together)])
        if isinstance(estimator, SampleMean) and estimator.separable:
            if self._noise is not None and self._cell.samples <= self._columns:
                return self._mean_of_batch(estimator, start, self._noise[start:stop])
            return np.stack([self._mean_of_parts(estimator, repeat) for repeat in range(start, stop)])
        if self._noise is not None:
            return self._estimate_batch(start, self._noise[start:stop])
        rows = []
        for repeat in range(start, stop):
            with self.pause:
                whole = np.concatenate(list(self._draw_parts(repeat)), axis=1)
            rows.append(self._estimate_batch(repeat, np.moveaxis(whole[:, None, :], 0, -1)))
        return np.concatenate(rows)

    @property
    def sums(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Per repeat, the sum of (term - common centre) and the sum of its squared norms; None without independent terms."""
        if self.design != IID or not self._terms:
            return None
        rests, squares = zip(*(self._terms[repeat] for repeat in sorted(self._terms)), strict=True)
        return np.array(rests), np.array(squares)

    def parts(self, repeat: int) -> Iterator[np.ndarray]:
        """Return an iterator over the noise of one repeat, in parts ``(n_w, b)``."""
        return iter([self._noise[repeat].T]) if self._noise is not None else self._draw_parts(repeat)

    def _draw_parts(self, repeat: int) -> Iterator[np.ndarray]:
        cell = self._cell
        for part in noise.parts(cell.seed, cell.scene.name, repeat, cell.samples, self._width, "cells", self.design):
            for first in range(0, part.shape[1], self._columns):
                yield part[:, first : first + self._columns]

    def _estimate_batch(self, start: int, block: np.ndarray) -> np.ndarray:
        result, self.diagnostics[start] = self._estimator.estimate_with_diagnostics(self._problem, self._theta, block)
        return self._checked(result, "(R, d)", block.shape[0], self._problem.dim)

    def _mean_of_batch(self, estimator: SampleMean, start: int, block: np.ndarray) -> np.ndarray:
        terms = self._terms_of(estimator, columns(block))
        split = per_repeat(terms, block)
        result: np.ndarray = split.mean(axis=1)
        with self.pause:
            for i, repeat in enumerate(range(start, start + len(block))):
                if repeat not in self._terms:
                    self._terms[repeat] = self._added((0.0, 0.0), split[i].T)
        return result

    def _mean_of_parts(self, estimator: SampleMean, repeat: int) -> np.ndarray:
        total, parts, found = np.zeros(self._problem.dim), self._draw_parts(repeat), (0.0, 0.0)
        while True:
            with self.pause:
                part = next(parts, None)
            if part is None:
                break
            terms = self._terms_of(estimator, part)
            total += terms.sum(axis=1)
            with self.pause:
                found = self._added(found, terms)
        self._terms.setdefault(repeat, found)
        return total / self._cell.samples

    def _added(self, found: tuple[Any, float], terms: np.ndarray) -> tuple[Any, float]:
        """Return the sums of a repeat with further terms ``(d, b)``. The first batch's mean is the centre."""
        if self._centre is None:
            self._centre = terms.mean(axis=1)
        with np.errstate(all="ignore"):
            rest = terms - self._centre[:, None]
            return found[0] + rest.sum(axis=1), found[1] + float(np.vdot(rest, rest))

    def _terms_of(self, estimator: SampleMean, w: np.ndarray) -> np.ndarray:
        return self._checked(estimator.terms(self._problem, self._theta, w), "(d, B)", self._problem.dim, w.shape[1])

    def _checked(self, result: Any, meaning: str, *shape: int) -> np.ndarray:
        """Return a result in float64, NaN where it is masked; raises an error if it is complex or has another shape."""
        if np.iscomplexobj(result):  # a cast would silently drop the imaginary part
            raise TypeError(f"{self._estimator.name} returned complex numbers; gradients are real")
        result = np.asarray(np.ma.filled(result, np.nan), dtype=np.float64)
        require_shape(self._estimator, meaning, result, shape)
        return result


def measure(cell: Cell, session: Session, study: BiasVariance) -> dict[str, Any]:
    """Return one cell's results by column: its status, the reason, and statistics of its estimates.

    A timed cell computes ``timed_calls`` estimates one by one, or all of them on a backend that compiles. Other cells
    compute all estimates together.
    """
    session.compilations.restart()
    program = cell.program()
    truth = session.references.of(cell)
    problem = session.problem(cell)
    estimates = CellEstimates(cell, problem, program.theta0)

    calls = (cell.repeats if cell.backend.compiles else min(study.timed_calls, cell.repeats)) if cell.timing else 0
    # count only the estimates: the reference may have used the same problem
    problem.reset_usage()
    started, compiled_s = time.perf_counter(), session.compilations.seconds
    parts: list[np.ndarray] = []
    clock, usage, n_counted = timing.Timing(math.nan, math.nan), problem.usage, cell.repeats
    if calls:
        timing.reset_peak_memory()
        parts, clock = timing.timed(
            lambda r: estimates.of(r, r + 1), calls, settle_s=study.settle_s, pause=estimates.pause
        )
        # a copy, because the estimates below, which are not timed, raise the counts further
        usage, n_counted = replace(usage), clock.calls
    if calls < cell.repeats:
        parts.append(estimates.of(calls, cell.repeats))
    elapsed = time.perf_counter() - started
    values = np.concatenate(parts)

    auxiliaries = summarise_diagnostics([estimates.diagnostics[start] for start in sorted(estimates.diagnostics)])
    result: dict[str, Any] = {
        "model_error": truth.model_error,
        "time_s": clock.median_s,
        "time_iqr_s": clock.iqr_s,
        "time_samples": list(clock.samples_s),
        "estimates_s": elapsed,
        "compile_s": session.compilations.seconds - compiled_s or math.nan,
        "rollouts": usage.rollouts / n_counted,
        "gradients": usage.gradients / n_counted,
        "device": problem.device,
        "compilations": session.compilations.made,
        "shapes": " ".join(sorted(session.compilations.shapes)),
        "point": program.theta0.tolist(),
        "mean_estimate": values.mean(axis=0).tolist(),
        "reference_gradient": truth.gradient.tolist(),
        "auxiliaries": auxiliaries,
    }
    if calls:
        result |= {
            "noise_s": noise.seconds(cell.seed, cell.scene.name, cell.samples, program.n_noise, estimates.design),
            "peak_memory_mb": timing.peak_memory_mb(),
        }
    if "value" in cell.estimator.needs:
        result |= costs_of(problem, next(estimates.parts(0)))
    if cell.point is not None:
        result |= {"start_norm": cell.point.start_norm, "descent_path": json.dumps(cell.point.along)}
    result |= against_reference(problem, cell.estimator, truth, values, cell.samples, estimates.sums, auxiliaries)
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any() and truth.is_finite:
        result["reason"] += f"; {locate_first_bad(cell, problem, estimates, int(np.argmax(bad)))}"
    return result


def costs_of(problem: Problem, w: np.ndarray) -> dict[str, float]:
    """Return the columns of the costs at theta with noise ``w (n_w, b)``: mean, and the range of 95% of them."""
    costs = problem.value(problem.program.theta0, w)
    return ends("cost", map(float, (costs.mean(), *np.quantile(costs, (0.025, 0.975)))))


def summarise_diagnostics(diagnostics: list[Auxiliaries]) -> str:
    """Return JSON: each diagnostic's mean, 5, 50 and 95% quantiles and share of exact zeros; empty without diagnostics."""
    table = {}
    for name in diagnostics[0] if diagnostics else ():
        values = np.concatenate([np.ravel(batch[name]) for batch in diagnostics]).astype(np.float64)
        if np.isfinite(values).all():
            low, median, high = np.quantile(values, (0.05, 0.5, 0.95)).tolist()
            table[name] = {
                "mean": float(values.mean()),
                "low": low,
                "median": median,
                "high": high,
                "zero": float((values == 0).mean()),
            }
    return json.dumps(table) if table else ""


def locate_first_bad(cell: Cell, problem: Problem, estimates: CellEstimates, repeat: int) -> str:
    """Return a string with the theta, seed and sample to reproduce an estimate that is not finite.

    The sample is the first one of the repeat whose cost or gradient at theta is not finite. There may be none: an
    estimator can compute an infinite estimate from finite costs and gradients, or evaluate them at another theta.
    """
    theta, before = problem.program.theta0, 0
    sample = "no single sample, costs and gradients are finite"
    for part in estimates.parts(repeat):
        is_bad = ~np.isfinite(problem.value(theta, part))
        if "grad" in cell.backend.provides:
            is_bad |= ~np.isfinite(problem.grad(theta, part)).all(axis=0)
        if is_bad.any():
            sample = f"sample {before + int(np.argmax(is_bad))}"
            break
        before += part.shape[1]
    text = np.array2string(theta, precision=17, threshold=8, separator=", ").replace("\n", "")
    return f"the first at seed {cell.seed}, repeat {repeat}, {sample}, theta {text}"
