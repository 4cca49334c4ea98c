"""Computes a cell's estimates. Noise too large for memory is drawn in parts.

An estimator that is a mean of terms is summed per repeat, part by part and in a fixed order. So memory does not grow
with samples or repeats, and the result is the same to the last digit for any number of threads and on any machine.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from bench.experiment.cell import Cell
from bench.measure import noise
from bench.measure.timing import Pause
from bench.model import Auxiliaries, Problem, SampleMean, columns, per_repeat
from bench.model.estimator import require_shape

from .. import all_noise

MOST_TERMS = 1 << 25
"""Most numbers in the terms of one call (256 MiB): d per sample. With more, fewer repeats or samples share a call."""


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
        self._noise = all_noise(cell, self._width) if fits else None
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
        """Per repeat, the sum of (term - common centre) and the sum of its squared norms; None without single terms."""
        ordered = [self._terms[repeat] for repeat in sorted(self._terms)]
        return (
            (np.array([rest for rest, _ in ordered]), np.array([square for _, square in ordered])) if ordered else None
        )

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
        """Return a result in float64; raises an error if it is complex or has another shape."""
        if np.iscomplexobj(result):  # a cast would silently drop the imaginary part
            raise TypeError(f"{self._estimator.name} returned complex numbers; gradients are real")
        result = np.asarray(result, dtype=np.float64)
        require_shape(self._estimator, meaning, result, shape)
        return result  # type: ignore[no-any-return]
