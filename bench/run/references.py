"""Reference gradients on disk: each is computed once, beside the experiments, and shared by all cells that need it."""

from __future__ import annotations

import io
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.keys import fingerprint
from bench.experiment.session import Problems
from bench.measure import reference, smoothed
from bench.measure.reference import Reference
from bench.model import Backend
from bench.run.files import make_directory, write_whole


class References:
    """The reference gradients of one run."""

    def __init__(self, experiment: Experiment, problems: Problems) -> None:
        self._problems = problems
        # absolute: a plugin at work may leave the working folder
        self._directory = experiment.results_dir.absolute() / "references"
        self._budget = experiment.reference
        self._known: dict[str, Reference] = {}

    def stored(self, cell: Cell) -> bool:
        """Return whether the reference of the cell's program is on disk."""
        return self._path(cell).exists()

    def of(self, cell: Cell) -> Reference:
        """Return the reference of the cell's program, from the best backend that can run it."""
        key = cell.reference_key
        if key not in self._known:
            result = load(self._path(cell))
            if result is None:
                result = self._certified(cell)
                save(result, self._path(cell))
            self._known[key] = result
        return self._known[key]

    def _certified(self, cell: Cell) -> Reference:
        """Compute the reference on the first backend that can; raises the first one's error where none can.

        A backend may accept a program and fail at it, at a branch on a traced value for example.
        """
        failed: list[tuple[str, Exception]] = []
        budget = self._budget.samples, self._budget.tolerance
        for backend in {fingerprint(b): b for b in cell.reference_backends}.values():
            try:
                result = self._of_backend(backend, cell, *budget)
            except Exception as error:
                failed.append((backend.name, error))
                continue
            if not failed:
                return result
            said = ", ".join(f"{name} ({type(error).__name__})" for name, error in failed)
            note = f"the reference is from {backend.name}, after a failure of {said}"
            return replace(result, note="; ".join(part for part in (note, result.note) if part))
        raise failed[0][1]

    def _of_backend(self, backend: Backend, cell: Cell, samples: int, tolerance: float) -> Reference:
        """Compute the reference on one backend: of J_sigma, or of the smoothing that the estimator asks for."""
        asked = cell.smoothing()
        if asked is None:
            problem = self._problems.of(backend, cell)
            return reference.certify(problem, backend.provides, samples, tolerance, self._stood_for(cell))
        if asked.shape == "ball":
            problem = self._problems.of(backend, cell)
            return smoothed.over_ball(problem, backend.provides, asked.radius, samples, tolerance)
        wider = backend.compile(smoothed.widened(cell.program(), asked.radius))
        found = reference.certify(wider, backend.provides, samples, tolerance)
        return replace(found, method=f"gaussian[radius={asked.radius:g}],{found.method}")

    def _path(self, cell: Cell) -> Path:
        return self._directory / f"{cell.reference_key}.parquet"

    def _stood_for(self, cell: Cell) -> np.ndarray | None:
        """Return the gradient that the program's own, at w = 0, approximates: the physics', if the scene knows it.

        For a backend with physics of its own and a scene that does not know the physics' gradient, it is that of the
        scene's own program.
        """
        program = cell.program()
        physical = program.physical_gradient()
        if physical is None and "physics" in cell.backend.provides:
            for backend in cell.ranked_backends:
                if "grad" in backend.provides:
                    still = np.zeros((program.n_noise, 1))
                    with suppress(Exception):  # a backend that fails at the program gives way to the next
                        return self._problems.of(backend, cell).grad(program.theta0, still)[:, 0]
        return physical


def save(reference: Reference, path: Path) -> None:
    """Store a reference as Parquet."""
    import pandas as pd

    lines = [("batch", row) for row in reference.batches]
    lines += [
        (name, value) for name, value in (("plain", reference.plain), ("physical", reference.physical)) if value.size
    ]
    table = pd.DataFrame(
        {"part": [name for name, _ in lines], "gradient": [list(row) for _, row in lines],
         "method": reference.method, "error": reference.error, "note": reference.note}
    )  # fmt: skip
    buffer = io.BytesIO()
    table.to_parquet(buffer, index=False)
    make_directory(path.parent)
    write_whole(path, buffer.getvalue())


def load(path: Path) -> Reference | None:
    """Load a stored reference; return None if there is none or it cannot be read."""
    import pandas as pd

    if not path.exists():
        return None
    try:
        table = pd.read_parquet(path)
        rows = {name: np.stack(list(part)) for name, part in table.groupby("part")["gradient"]}
        vectors = {name: rows[name][0] for name in ("plain", "physical") if name in rows}
        words = str(table["method"][0]), float(table["error"][0])
        return Reference(rows["batch"], *words, **vectors, note=str(table["note"][0]))
    except Exception:
        return None
