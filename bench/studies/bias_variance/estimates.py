"""A cell's estimates from noise that is held whole, or drawn part by part where that would take much memory.

Terms of an estimator that is a mean are summed per repeat in a fixed order, part by part, so memory does not grow with
samples or repeats, and neither threads nor the machine change a digit.
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

KEPT = 100_000
"""Norms of single terms that are kept for their quantiles: as many of each repeat, the first ones."""
QUANTILES = {"sample_low": 0.05, "sample_median": 0.5, "sample_high": 0.95}
"""Columns of quantiles of the norm of a single term."""


@dataclass
class Seen:
    """What is remembered of the terms of one repeat."""

    count: int = 0
    zeros: int = 0
    sizes: list[np.ndarray] = field(default_factory=list)


class Estimates:
    """The independent estimates of a cell, computed on request, and what they leave behind."""

    def __init__(self, cell: Cell, problem: Problem, theta: np.ndarray) -> None:
        self.pause = Pause()
        """Time spent drawing noise and on statistics, which is no time of an estimate."""
        self.decided: dict[int, Auxiliaries] = {}
        """What the estimator reports, by first repeat."""
        self._cell, self._problem, self._theta = cell, problem, theta
        self._width = problem.program.n_noise
        self._estimator = cell.estimator
        held = cell.repeats * cell.samples * self._width <= noise.HELD
        self._noise = (
            noise.shared(cell.seed, cell.scene.name, cell.repeats, cell.samples, self._width) if held else None
        )
        self._centre: np.ndarray | None = None
        self._sums: dict[int, tuple[np.ndarray, float]] = {}
        self._seen: dict[int, Seen] = {}

    def of(self, start: int, stop: int) -> np.ndarray:
        """Return the estimates of some repeats, ``(stop - start, d)``."""
        estimator = self._estimator
        if isinstance(estimator, SampleMean) and estimator.separable:
            if self._noise is not None:
                return self._means(estimator, start, self._noise[start:stop])
            return np.stack([self._mean(estimator, repeat) for repeat in range(start, stop)])
        if self._noise is not None:
            return self._explained(start, self._noise[start:stop])
        rows = []
        for repeat in range(start, stop):
            with self.pause:
                whole = np.concatenate(list(self._drawn(repeat)), axis=1)
            rows.append(self._explained(repeat, np.moveaxis(whole[:, None, :], 0, -1)))
        return np.concatenate(rows)

    @property
    def sums(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Sums of all terms and of their squared norms per repeat, less a common centre; None without single terms."""
        if not self._sums:
            return None
        ordered = [self._sums[repeat] for repeat in sorted(self._sums)]
        return np.array([total for total, _ in ordered]), np.array([square for _, square in ordered])

    @property
    def singles(self) -> dict[str, float]:
        """The share of samples whose term is exactly 0, and quantiles of the norm of one; NaN without single terms."""
        whole = [self._seen[repeat] for repeat in sorted(self._seen)]
        sizes = np.concatenate([part for one in whole for part in one.sizes]) if whole else np.empty(0)
        if not np.isfinite(sizes).all() or not sizes.size:
            return dict.fromkeys(("sample_zeros", *QUANTILES), math.nan)
        zeros = sum(one.zeros for one in whole) / sum(one.count for one in whole)
        values = np.quantile(sizes, list(QUANTILES.values()))
        return {"sample_zeros": zeros, **dict(zip(QUANTILES, values.tolist(), strict=True))}

    def parts(self, repeat: int) -> Iterator[np.ndarray]:
        """Yield the noise of one repeat in parts ``(n_w, b)``."""
        return iter([self._noise[repeat].T]) if self._noise is not None else self._drawn(repeat)

    def _drawn(self, repeat: int) -> Iterator[np.ndarray]:
        cell = self._cell
        return noise.parts(cell.seed, cell.scene.name, repeat, cell.samples, self._width, "cells")

    def _explained(self, start: int, block: np.ndarray) -> np.ndarray:
        result, self.decided[start] = self._estimator.estimate_with_diagnostics(self._problem, self._theta, block)
        result = self._real(result)
        self._check(result, (block.shape[0], self._problem.dim))
        return result

    def _means(self, estimator: SampleMean, start: int, block: np.ndarray) -> np.ndarray:
        terms = self._real(estimator.terms(self._problem, self._theta, columns(block)))
        self._check(terms, (self._problem.dim, block.shape[0] * block.shape[1]))
        split = per_repeat(terms, block)
        result: np.ndarray = split.mean(axis=1)
        with self.pause:
            for i, repeat in enumerate(range(start, start + len(block))):
                if repeat not in self._sums:
                    self._sums[repeat] = self._summed(split[i].T)
                    self._seen[repeat] = self._look(Seen(), split[i].T)
        return result

    def _mean(self, estimator: SampleMean, repeat: int) -> np.ndarray:
        total, sums, square = np.zeros(self._problem.dim), np.zeros(self._problem.dim), 0.0
        drawn, seen = self._drawn(repeat), Seen()
        while True:
            with self.pause:
                part = next(drawn, None)
            if part is None:
                break
            terms = self._real(estimator.terms(self._problem, self._theta, part))
            self._check(terms, (self._problem.dim, part.shape[1]))
            total += terms.sum(axis=1)
            with self.pause:
                more = self._summed(terms)
                sums, square = sums + more[0], square + more[1]
                self._look(seen, terms)
        self._sums.setdefault(repeat, (sums, square))
        self._seen.setdefault(repeat, seen)
        return total / self._cell.samples

    def _summed(self, terms: np.ndarray) -> tuple[np.ndarray, float]:
        """Return sum and sum of squared norms of terms ``(d, b)`` less the mean of the first ones seen."""
        if self._centre is None:
            self._centre = terms.mean(axis=1)
        with np.errstate(all="ignore"):
            rest = terms - self._centre[:, None]
            return rest.sum(axis=1), float(np.vdot(rest, rest))

    def _real(self, result: Any) -> np.ndarray:
        if np.iscomplexobj(result):  # a cast would drop the imaginary part without a word
            raise TypeError(f"{self._estimator.name} returned complex numbers; gradients are real")
        return np.asarray(result, dtype=np.float64)

    def _look(self, seen: Seen, terms: np.ndarray) -> Seen:
        """Count terms ``(d, b)`` that are exactly 0, and keep the norms of a repeat's first ones."""
        room = max(1, KEPT // self._cell.repeats) - sum(map(len, seen.sizes))
        with np.errstate(all="ignore"):
            seen.sizes.append(np.linalg.norm(terms[:, : max(0, room)], axis=0))
        seen.zeros += int((terms == 0.0).all(axis=0).sum())
        seen.count += terms.shape[1]
        return seen

    def _check(self, result: np.ndarray, shape: tuple[int, ...]) -> None:
        if result.shape != shape:
            raise ValueError(f"{self._estimator.name} returned shape {result.shape}, not {shape}")
