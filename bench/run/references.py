"""Computes each reference gradient once, stores it beside the experiments, and shares it among all cells that need it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.keys import fingerprint, hash_of_text
from bench.experiment.session import Problems
from bench.measure import reference, smoothed
from bench.measure.reference import Reference
from bench.model import Backend, Problem
from bench.run.shared import Shared


class References:
    """The reference gradients of one run."""

    def __init__(self, experiment: Experiment, problems: Problems) -> None:
        self._problems = problems
        self._shared = Shared(experiment)
        self._budget = experiment.reference
        self._references: dict[str, Reference] = {}
        self.stores = True
        """Whether computed references are stored for other cells."""

    def stored(self, cell: Cell) -> bool:
        """Return whether the reference of the cell's program is on disk, and all that it has read is unchanged."""
        return self._load(cell.reference_key) is not None

    def _load(self, key: str) -> Reference | None:
        found: dict[str, Any] = self._shared.load(key) or {}
        with suppress(TypeError, ValueError):  # it is no reference
            lists = {
                name: np.array(value, dtype=np.float64) for name, value in found.items() if isinstance(value, list)
            }
            reference = Reference(**{**found, **lists})
            if reference.batches.ndim == 2 and reference.batches.size and isinstance(reference.error, float):
                return reference
        return None

    def of(self, cell: Cell) -> Reference:
        """Return the reference of the cell's program, from the best backend that can run it, in arrays of the caller's own.

        Where costs of the cell's own backend differ from those of that one, the cell's backend computes its own.
        """
        shared = self._known(cell.reference_key, lambda: self._compute(cell))
        own = fingerprint(cell.backend)
        if own == fingerprint(cell.reference_backends[0]) or shared.method == "closed_form":
            return deepcopy(shared)
        key = f"{cell.reference_key}-{hash_of_text(own)}"
        return deepcopy(self._known(key, lambda: self._for_backend(shared, cell)))

    def _known(self, key: str, compute: Callable[[], Reference]) -> Reference:
        """Return the reference of a key, loaded or computed at first use."""
        if key not in self._references:
            result = self._load(key)
            if result is None:
                result = compute()
                if self.stores:
                    self._shared.save(key, vars(result))
            self._references[key] = result
        return self._references[key]

    def _compute(self, cell: Cell) -> Reference:
        """Compute the reference on the first backend that can; raises the error of the first backend if none can.

        A backend may accept a program and then fail to run it, for example at a branch on a traced value. Then the next
        backend is used.
        """
        failed: list[tuple[str, Exception]] = []
        for backend in {fingerprint(b): b for b in cell.reference_backends}.values():
            try:
                result = self._compute_on(backend, cell)
            except Exception as error:
                failed.append((backend.name, error))
                continue
            if not failed:
                return result
            failures = ", ".join(f"{name} ({type(error).__name__})" for name, error in failed)
            note = f"the reference is from {backend.name}, after a failure of {failures}"
            return reference.with_note(result, note)
        raise failed[0][1]

    def _for_backend(self, shared: Reference, cell: Cell) -> Reference:
        """Return a reference of another backend if it is that of the cell's own program, else the cell's backend's own."""
        first = cell.reference_backends[0]
        unit, name = float(np.finfo(cell.backend.dtype).eps), cell.backend.name
        note = f"costs of {name} differ from those of {first.name}, so the reference is from {name}"
        try:
            of_first, own = self._problem(first, cell), self._problem(cell.backend, cell)
            found = reference.transferred(shared, of_first, own, self._budget.samples, unit)
        except Exception as error:  # another backend has computed the reference
            found, note = (
                None,
                f"the reference is from {name}, after a failure of {first.name} ({type(error).__name__})",
            )
        if found is not None:
            return found
        return reference.with_note(self._compute_on(cell.backend, cell), note)

    def _problem(self, backend: Backend, cell: Cell) -> Problem:
        """Return the cell's program on a backend, with the noise of the smoothing that the estimator needs."""
        smoothing = cell.smoothing()
        if smoothing is None or smoothing.shape == "ball":
            return self._problems.of(backend, cell)
        return backend.compile(smoothed.widened(cell.program(), smoothing.radius))

    def _compute_on(self, backend: Backend, cell: Cell) -> Reference:
        """Compute the reference of J_sigma, or of the smoothed objective that the estimator needs, on one backend."""
        budget, smoothing = (self._budget.samples, self._budget.tolerance), cell.smoothing()
        problem = self._problem(backend, cell)
        if smoothing is None:
            physical = self._physical_gradient(cell)
            return reference.certify(problem, backend.provides, *budget, physical, self._budget.points)
        if smoothing.shape == "ball":
            return smoothed.over_ball(problem, backend.provides, smoothing.radius, *budget)
        result = reference.certify(problem, backend.provides, *budget, points=self._budget.points)
        return replace(result, method=f"gaussian[radius={smoothing.radius:g}],{result.method}")

    def _physical_gradient(self, cell: Cell) -> np.ndarray | None:
        """Return the exact gradient at w = 0 that the program's gradient approximates, shape (d,); None if unknown.

        The scene may declare it. Otherwise, if the cell's backend has physics of its own, it is the gradient of the
        scene's own program.
        """
        program = cell.program()
        physical = program.physical_gradient()
        if physical is None and "physics" in cell.backend.provides:
            for backend in cell.ranked_backends:
                if "grad" in backend.provides:
                    with suppress(Exception):  # if a backend cannot run the program, the next one is used
                        return self._problems.of(backend, cell).grad()
        return physical
