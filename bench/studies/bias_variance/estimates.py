"""Computes a cell's estimates. Noise too large for memory is drawn in parts.

An estimator that is a mean of terms is summed per repeat, part by part and in a fixed order. So memory does not grow
with samples or repeats, and the result is the same to the last digit for any number of threads and on any machine.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.experiment.cell import Cell
from bench.measure import noise
from bench.measure.timing import Pause
from bench.model import Auxiliaries, Problem, SampleMean, columns, per_repeat

MOST_NORMS = 100_000
"""Most norms of single terms to store for their quantiles: the first ones of each repeat, equally many per repeat."""
MOST_TERMS = 1 << 25
"""Most numbers in the terms of one call (256 MiB): d per sample. With more, fewer repeats or samples share a call."""
QUANTILES = {"sample_low": 0.05, "sample_median": 0.5, "sample_high": 0.95}
"""Columns with quantiles of the norm of a single term, and the quantile of each."""


@dataclass
class Terms:
    """Sums over the terms of one repeat."""

    rest: Any = 0.0
    """The sum of (term - common centre), ``(d,)``."""
    square: float = 0.0
    """The sum of the squared norms of the same."""
    count: int = 0
    zeros: int = 0
    """Number of terms that are exactly 0."""
    norms: list[np.ndarray] = field(default_factory=list)
    """Norms of the first terms."""


class Estimates:
    """The independent estimates of a cell, computed on request, and statistics of their single terms."""

    def __init__(self, cell: Cell, problem: Problem, theta: np.ndarray) -> None:
        self.pause = Pause()
        """Time [s] spent on drawing noise and on statistics, excluded from the time of an estimate."""
        self.diagnostics: dict[int, Auxiliaries] = {}
        """Diagnostics that the estimator reports, by the first repeat of the batch."""
        self._cell, self._problem, self._theta = cell, problem, theta
        self._width = problem.program.n_noise
        self._estimator = cell.estimator
        self._columns = max(1, MOST_TERMS // problem.dim)
        fits = cell.repeats * cell.samples * self._width <= noise.HELD
        self._noise = (
            noise.shared(cell.seed, cell.scene.name, cell.repeats, cell.samples, self._width) if fits else None
        )
        self._centre: np.ndarray | None = None
        self._terms: dict[int, Terms] = {}

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
        """Per repeat, the sum of (term - common centre) and the sum of its squared norms; None without single terms."""
        ordered = [self._terms[repeat] for repeat in sorted(self._terms)]
        return (np.array([one.rest for one in ordered]), np.array([one.square for one in ordered])) if ordered else None

    @property
    def singles(self) -> dict[str, float]:
        """The share of samples whose term is exactly 0, and quantiles of a term's norm; NaN without finite single terms."""
        repeats = [self._terms[repeat] for repeat in sorted(self._terms)]
        norms = np.concatenate([part for repeat in repeats for part in repeat.norms]) if repeats else np.empty(0)
        if not np.isfinite(norms).all() or not norms.size:
            return dict.fromkeys(("sample_zeros", *QUANTILES), math.nan)
        zeros = sum(repeat.zeros for repeat in repeats) / sum(repeat.count for repeat in repeats)
        values = np.quantile(norms, list(QUANTILES.values()))
        return {"sample_zeros": zeros, **dict(zip(QUANTILES, values.tolist(), strict=True))}

    def parts(self, repeat: int) -> Iterator[np.ndarray]:
        """Return an iterator over the noise of one repeat, in parts ``(n_w, b)``."""
        return iter([self._noise[repeat].T]) if self._noise is not None else self._draw_parts(repeat)

    def _draw_parts(self, repeat: int) -> Iterator[np.ndarray]:
        cell = self._cell
        for part in noise.parts(cell.seed, cell.scene.name, repeat, cell.samples, self._width, "cells"):
            for first in range(0, part.shape[1], self._columns):
                yield part[:, first : first + self._columns]

    def _estimate_batch(self, start: int, block: np.ndarray) -> np.ndarray:
        result, self.diagnostics[start] = self._estimator.estimate_with_diagnostics(self._problem, self._theta, block)
        result = self._as_float64(result)
        self._check_shape(result, (block.shape[0], self._problem.dim))
        return result

    def _mean_of_batch(self, estimator: SampleMean, start: int, block: np.ndarray) -> np.ndarray:
        terms = self._as_float64(estimator.terms(self._problem, self._theta, columns(block)))
        self._check_shape(terms, (self._problem.dim, block.shape[0] * block.shape[1]))
        split = per_repeat(terms, block)
        result: np.ndarray = split.mean(axis=1)
        with self.pause:
            for i, repeat in enumerate(range(start, start + len(block))):
                if repeat not in self._terms:
                    self._terms[repeat] = self._added(Terms(), split[i].T)
        return result

    def _mean_of_parts(self, estimator: SampleMean, repeat: int) -> np.ndarray:
        total, parts, found = np.zeros(self._problem.dim), self._draw_parts(repeat), Terms()
        while True:
            with self.pause:
                part = next(parts, None)
            if part is None:
                break
            terms = self._as_float64(estimator.terms(self._problem, self._theta, part))
            self._check_shape(terms, (self._problem.dim, part.shape[1]))
            total += terms.sum(axis=1)
            with self.pause:
                self._added(found, terms)
        self._terms.setdefault(repeat, found)
        return total / self._cell.samples

    def _added(self, found: Terms, terms: np.ndarray) -> Terms:
        """Add terms ``(d, b)`` to the sums of their repeat, and return the sums. The first batch's mean is the centre."""
        if self._centre is None:
            self._centre = terms.mean(axis=1)
        room = max(1, MOST_NORMS // self._cell.repeats) - sum(map(len, found.norms))
        with np.errstate(all="ignore"):
            rest = terms - self._centre[:, None]
            found.rest, found.square = found.rest + rest.sum(axis=1), found.square + float(np.vdot(rest, rest))
            found.norms.append(np.linalg.norm(terms[:, : max(0, room)], axis=0))
        found.zeros += int((terms == 0.0).all(axis=0).sum())
        found.count += terms.shape[1]
        return found

    def _as_float64(self, result: Any) -> np.ndarray:
        if np.iscomplexobj(result):  # a cast would silently drop the imaginary part
            raise TypeError(f"{self._estimator.name} returned complex numbers; gradients are real")
        return np.asarray(result, dtype=np.float64)

    def _check_shape(self, result: np.ndarray, shape: tuple[int, ...]) -> None:
        if result.shape != shape:
            raise ValueError(f"{self._estimator.name} returned shape {result.shape}, not {shape}")
