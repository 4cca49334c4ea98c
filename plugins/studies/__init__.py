"""The built-in studies: what to measure per cell, and the tables, charts and page to write."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.study import Study
from bench.experiment.views import Views
from bench.measure import noise, statistics, timing
from bench.measure.reference import Reference
from bench.model import SURROGATE, Estimator, Integrator, Problem, Program

if TYPE_CHECKING:
    import pandas as pd

PARTS = ("scene", "contact", "integrator", "backend")
"""Parts of the grid that identify a program: the axes of a study without estimators."""
SPREAD = 0.5
"""A gradient is trusted where one estimate spreads by less than this multiple of its mean, and a check finds nothing against it."""


@dataclass(frozen=True)
class StudyPackage(Study):
    """A built-in study: a file with ``measure`` and ``show``, or a package with modules ``measure`` and ``views``.

    These modules have a function of that name, and are imported at first use.
    """

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column."""
        return self._module("measure").measure(cell, session, self)

    def views(self, experiment: Experiment, rows: pd.DataFrame) -> Views:
        """Return the tables of the rows and the charts that are not empty, and why cells have no result.

        Where a study has nothing to show, this is a file with the status of each cell.
        """
        from bench.report import generic
        from bench.report.writer import reasons

        found = self.show(experiment, rows)
        if found is None:
            found = Views([replace(table, terminal=False) for table in generic.views(experiment, rows).tables])
        drawn = [chart for chart in found.charts if len(chart.frame)]
        return replace(found, charts=drawn, remarks=[*found.remarks, *reasons(rows)])

    def show(self, experiment: Experiment, rows: pd.DataFrame) -> Views | None:
        """Return the tables of the rows and the charts; None without any."""
        return self._module("views").views(experiment, rows)

    def _module(self, name: str) -> Any:
        package = next(c.__module__ for c in type(self).__mro__ if hasattr(sys.modules[c.__module__], "__path__"))
        return import_module(f"{package}.{name}")


def against_reference(
    problem: Problem,
    estimator: Estimator | None,
    truth: Reference,
    estimates: np.ndarray,
    samples: int,
    terms: tuple[np.ndarray, np.ndarray] | None = None,
    auxiliaries: str = "",
) -> dict[str, Any]:
    """Return the columns of ``estimates (R, d)`` against the certified reference: status, reason, and statistics.

    Every study's biases, errors and cosines of estimates are computed here. Without an estimator, the estimates are means
    of a sample's terms, and nothing is declared of them. ``terms`` are as in :func:`~bench.measure.statistics.summarise`,
    ``auxiliaries`` the estimator's diagnostics as JSON.
    """
    result = {"reference_method": truth.method, "reference_spacing": truth.spacing}
    if not truth.is_finite:
        return result | {"status": "nonfinite", "reason": truth.note or "the reference gradient is not finite"}
    program = problem.program
    draws = estimator is None or estimator.draws_noise(program)
    unbiased = estimator is not None and estimator.declares_unbiased(program)
    estimates, is_random = np.asarray(estimates, dtype=np.float64), draws or program.exogenous > 0
    summary = statistics.summarise(estimates, truth.known(), samples if draws else 1, terms, unbiased, is_random)
    surrogate = SURROGATE if estimator and program.surrogate and "grad" in estimator.needs else ""
    doubt = estimator.remark(json.loads(auxiliaries)) if estimator and auxiliaries else ""
    remarks = (surrogate, summary.note, doubt, truth.note)
    values = {name: value for name, value in vars(summary).items() if name != "note"}
    return result | values | finite_status("", estimates) | {"reason": "; ".join(filter(None, remarks))}


def finite_status(reason: str, *values: Any) -> dict[str, str]:
    """Return the columns ``status`` and ``reason`` of numbers that may not be finite."""
    is_finite = all(np.isfinite(value).all() for value in values)
    return {"status": "ok" if is_finite else "nonfinite", "reason": "" if is_finite else reason}


def norm(vector: np.ndarray) -> float:
    """Return the norm of a vector."""
    return float(np.linalg.norm(vector))


def ratio(value: float, size: float) -> float:
    """Return a value in units of a size, NaN if that is 0."""
    return value / size if size > 0 else math.nan


def relative_error(vector: np.ndarray, expected: np.ndarray) -> float:
    """Return the distance of two vectors relative to the norm of the second."""
    return ratio(norm(vector - expected), norm(expected))


def mean_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Return the mean of independent values ``(n,)``, at least two, and the ends of its 95% interval (Student's t)."""
    from scipy.special import stdtrit

    reach = float(stdtrit(values.size - 1, 0.975)) * float(values.std(ddof=1)) / math.sqrt(values.size)
    mean = float(values.mean())
    return mean, mean - reach, mean + reach


def all_noise(cell: Cell, program: Program) -> np.ndarray:
    """Return the noise of all rollouts of a cell, ``(repeats, samples, n_w)``."""
    counts = (cell.repeats, cell.samples, program.n_noise)
    return noise.shared(cell.seed, cell.scene.name, *counts, cell.design(program))


def first_batch(cell: Cell, width: int) -> np.ndarray:
    """Return the noise of the first ``samples`` rollouts of a cell, ``(width, samples)``."""
    return np.ascontiguousarray(noise.shared(cell.seed, cell.scene.name, 1, cell.samples, width)[0].T)


def gradient_seconds(problem: Problem, w: np.ndarray, calls: int) -> dict[str, float]:
    """Return the median time [s] of gradients of the noise ``w (n_w, B)``, and the time [s] to compile them."""
    problem.reset_usage()
    _, clock = timing.timed(lambda _: problem.grad(problem.program.theta0, w), calls)
    return {"gradient_s": clock.median_s, "compile_s": problem.usage.compile_s}


def spectral_radius(integrator: Integrator, dt: float, stiffness: float, damping: float, factor: float) -> float:
    """Return the spectral radius of one step of length ``dt`` [s] on an oscillator of mass 1."""
    matrix = integrator.transition(dt, stiffness, damping, factor)
    return float(np.abs(np.linalg.eigvals(matrix)).max())
