"""Computes each reference gradient once, stores it beside the experiments, and shares it among all cells that need it."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.keys import fingerprint, hash_of_text
from bench.experiment.session import Problems
from bench.measure import reference, smoothed
from bench.measure.reference import Reference
from bench.model import Backend, Problem, reads, registry
from bench.run.files import make_directory, write_whole
from bench.run.rows import read_parquet

SCALARS = ("method", "error", "note", "spacing", "samples")
"""Fields of a reference that are one value."""


class References:
    """The reference gradients of one run."""

    def __init__(self, experiment: Experiment, problems: Problems) -> None:
        self._problems = problems
        # absolute, since a plugin may change the working folder
        self._directory = experiment.results_dir.absolute() / "references"
        self._budget = experiment.reference
        self._references: dict[str, Reference] = {}
        self._present = reads.Present(registry.environment())
        self.stores = True
        """Whether computed references are stored for other cells."""

    def stored(self, cell: Cell) -> bool:
        """Return whether the reference of the cell's program is on disk, and all that it has read is unchanged."""
        return self._load(self._path(cell)) is not None

    def _load(self, path: Path) -> Reference | None:
        result, read = load(path), read_by(path)
        if result is None or self._present.change(read):
            return None
        reads.include(read)
        return result

    def of(self, cell: Cell) -> Reference:
        """Return the reference of the cell's program, from the best backend that can run it, in arrays of the caller's own.

        Where costs of the cell's own backend differ from those of that one, the cell's backend computes its own.
        """
        shared = self._known(self._path(cell), lambda: self._compute(cell))
        own = fingerprint(cell.backend)
        if own == fingerprint(cell.reference_backends[0]) or shared.method == "closed_form":
            return deepcopy(shared)
        path = self._path(cell, f"-{hash_of_text(own)}")
        return deepcopy(self._known(path, lambda: self._for_backend(shared, cell)))

    def _known(self, path: Path, compute: Callable[[], Reference]) -> Reference:
        """Return the reference of a path, loaded or computed at first use."""
        if path.name not in self._references:
            result = self._load(path)
            if result is None:
                result = compute()
                if self.stores:
                    save(result, path, reads.manifest())
            self._references[path.name] = result
        return self._references[path.name]

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

    def _path(self, cell: Cell, backend: str = "") -> Path:
        return self._directory / f"{cell.reference_key}{backend}.parquet"

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
                    no_noise = np.zeros((program.n_noise, 1))
                    with suppress(Exception):  # if a backend cannot run the program, the next one is used
                        return self._problems.of(backend, cell).grad(program.theta0, no_noise)[:, 0]
        return physical


def save(reference: Reference, path: Path, read: str = "") -> None:
    """Store a reference as Parquet, with what code from outside has read."""
    import pandas as pd

    rows = [("batch", row) for row in reference.batches]
    rows += [
        (name, value) for name, value in (("plain", reference.plain), ("physical", reference.physical)) if value.size
    ]
    table = pd.DataFrame(
        {"part": [name for name, _ in rows], "gradient": [list(row) for _, row in rows],
         **{name: getattr(reference, name) for name in SCALARS}, "reads": read}
    )  # fmt: skip
    buffer = io.BytesIO()
    table.to_parquet(buffer, index=False)
    make_directory(path.parent)
    write_whole(path, buffer.getvalue())


def load(path: Path) -> Reference | None:
    """Load a stored reference; returns None if the file is missing or unreadable."""
    if not path.is_file():
        return None
    try:
        table = read_parquet(path)
        # a file has None for NaN
        rows = {name: np.array([*part], dtype=np.float64) for name, part in table.groupby("part")["gradient"]}
        vectors = {name: rows[name][0] for name in ("plain", "physical") if name in rows}
        return Reference(rows["batch"], **vectors, **table.loc[0, list(SCALARS)])
    except Exception:
        return None


def read_by(path: Path) -> str:
    """Return what code from outside has read for a stored reference; empty if the file does not say."""
    with suppress(Exception):
        return str(read_parquet(path, ["reads"])["reads"][0])
    return ""
