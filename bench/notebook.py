"""Problems and estimates as a notebook shows them: a line of text, and a table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike

from bench.errors import UserError, printable
from bench.model import Problem
from bench.model.identity import label
from bench.model.parameters import parameters

if TYPE_CHECKING:
    import pandas as pd

    from bench.measure.statistics import Summary


class NotebookProblem(Problem):
    """A compiled problem that a notebook shows, and whose arguments may be lists.

    Its class is also the class of the backend's own problem.
    """

    backend: str
    """Identity string of the backend."""

    def value(self, theta: ArrayLike | None = None, w: ArrayLike | None = None) -> np.ndarray:
        """Return the costs ``(B,)``, or ``()`` for one sample ``w (n_w,)``; see :meth:`grad` for the arguments."""
        theta, w, is_single = self._arguments(theta, w)
        costs = super().value(theta, w)
        return costs[0] if is_single else costs

    def grad(self, theta: ArrayLike | None = None, w: ArrayLike | None = None) -> np.ndarray:
        """Return the gradient df/dtheta of each sample, ``(d, B)``, or ``(d,)`` for one sample ``w (n_w,)``.

        ``theta`` is ``(d,)`` or ``(d, B)``, by default ``theta0``. ``w`` is ``(n_w,)`` or ``(n_w, B)``, by default 0,
        without noise. Both may be lists. Raises :class:`bench.UserError` for other shapes.
        """
        theta, w, is_single = self._arguments(theta, w)
        gradients = super().grad(theta, w)
        return gradients[:, 0] if is_single else gradients

    def score(self, theta: ArrayLike | None = None, w: ArrayLike | None = None) -> np.ndarray:
        """Return the score of each sample, ``(d, B)``, or ``(d,)`` for one sample; see :meth:`grad` for the arguments."""
        theta, w, is_single = self._arguments(theta, w)
        scores = super().score(theta, w)
        return scores[:, 0] if is_single else scores

    def _arguments(self, theta: ArrayLike | None, w: ArrayLike | None) -> tuple[np.ndarray, np.ndarray, bool]:
        """Return theta, noise ``(n_w, B)``, and whether one sample was given as a vector."""
        n_noise = self.program.n_noise
        at = np.asarray(self.program.theta0 if theta is None else theta, dtype=np.float64)
        if at.ndim not in (1, 2) or len(at) != self.dim:
            raise UserError(f"theta has the shape {at.shape}: give ({self.dim},) or ({self.dim}, B)")
        noise = np.zeros(n_noise) if w is None else np.asarray(w, dtype=np.float64)
        if noise.ndim not in (1, 2) or len(noise) != n_noise:
            raise UserError(f"noise w has the shape {noise.shape}: give ({n_noise},) or ({n_noise}, B)")
        if noise.ndim == 2:
            return at, noise, False
        columns = 1 if at.ndim == 1 else at.shape[1]
        return at, np.broadcast_to(noise[:, None], (n_noise, columns)), at.ndim == 1

    @property
    def title(self) -> str:
        """Identity strings of scene, contact law, integrator and backend."""
        return printable(", ".join([*map(label, self.program.parts.values()), self.backend]))

    def _facts(self) -> dict[str, str]:
        """Return the facts that identify the problem, as text."""
        on = "theta" if self.program.noise == "parameter" else "the actions"
        facts = {
            **{axis: label(part) for axis, part in self.program.parts.items()},
            "backend": self.backend,
            "theta": f"{_vector(self.program.theta0)}, d = {self.dim}",
            "noise": f"sigma = {self.sigma:g} on {on}, n_w = {self.program.n_noise}",
        }
        return {name: printable(fact) for name, fact in facts.items()}

    def __repr__(self) -> str:
        facts = self._facts()
        return f"Problem: {self.title}; theta = {facts['theta']}; noise: {facts['noise']}"

    def to_frame(self) -> pd.DataFrame:
        """Return all parameters of scene, contact law and integrator: part, plugin, name, value, unit and meaning."""
        import pandas as pd

        rows = [
            {"part": axis, "plugin": part.name, "parameter": name, "value": getattr(part, name)}
            | {"unit": parameter.unit, "meaning": parameter.doc}
            for axis, part in self.program.parts.items()
            for name, parameter in parameters(type(part)).items()
        ]
        return pd.DataFrame(rows, columns=["part", "plugin", "parameter", "value", "unit", "meaning"])


@cache
def _notebook_class(backend_class: type[Problem]) -> type[Problem]:
    return type(backend_class.__name__, (NotebookProblem, backend_class), {"__doc__": backend_class.__doc__})


def for_notebook(problem: Problem, backend: str) -> NotebookProblem:
    """Give a compiled problem the methods of :class:`NotebookProblem`, in place; return it."""
    problem.__class__ = _notebook_class(type(problem))
    converted = cast(NotebookProblem, problem)
    converted.backend = backend
    return converted


def component_names(problem: Problem) -> list[str]:
    """Return the names of theta's components: of the named parameters, or ``theta[0]``, ``theta[1]``, ..."""
    return list(problem.program.decision.names) or [f"theta[{index}]" for index in range(problem.dim)]


def _vector(values: np.ndarray) -> str:
    """Return a vector as text, without its middle if it is long."""
    texts = [f"{value:.4g}" for value in values]
    return f"[{', '.join(texts if len(texts) <= 6 else [*texts[:3], '...', *texts[-2:]])}]"


@dataclass(frozen=True, eq=False)
class Estimates:
    """Independent estimates of a gradient, compared with the reference gradient."""

    problem: Problem
    estimator: str
    """Identity string of the estimator."""
    samples: int
    """N, the number of samples in each estimate."""
    values: np.ndarray
    """The estimates, ``(R, d)``."""
    reference: np.ndarray
    """The reference gradient, ``(d,)``."""
    reference_method: str
    summary: Summary
    """Bias and variance with 95% intervals, see :class:`bench.measure.statistics.Summary`."""
    auxiliaries: Mapping[str, np.ndarray]
    """Diagnostics of the estimator by name, such as a weight, each ``(R,)`` or ``(R, d)``."""

    def _title(self) -> str:
        title = self.problem.title if isinstance(self.problem, NotebookProblem) else self.problem.program.scene.name
        return printable(f"{self.estimator} on {title}: {len(self.values)} estimates of {self.samples} samples")

    def _facts(self) -> dict[str, str]:
        """Return the statistics as text, relative to the norm of the reference unless that may be 0."""
        from bench.report.text import number
        from bench.report.views import bias_text, rmse_interval

        row = self.as_dict()
        norm = row["reference_norm"]
        is_relative = math.isfinite(row["rmse_rel"])
        low, high = (float(end) for end in rmse_interval(row))
        unit = 1.0 if is_relative else norm or 1.0
        kind = "relative " if is_relative else ""
        interval = f" [{number(low * unit, 3)}, {number(high * unit, 3)}]" if math.isfinite(low + high) else ""
        error = number(row["rmse_rel"] if is_relative else row["rmse"], 3)
        facts = {
            f"{kind}bias": bias_text(row, norm if is_relative else 1.0),
            f"{kind}RMSE": f"{error}{interval}",
            "cosine": number(row["cosine"], 3),
            "variance": number(row["variance"], 3),
            "|grad J|": f"{number(norm, 3)} ({self.reference_method})",
            "remark": row["note"],
        }
        return {name: printable(fact) for name, fact in facts.items() if fact}

    def __str__(self) -> str:
        return f"{self._title()}\n" + "; ".join(f"{name} {fact}" for name, fact in self._facts().items())

    __repr__ = __str__

    def as_dict(self) -> dict[str, Any]:
        """Return the statistics by the names of the main table's columns."""
        return asdict(self.summary)

    def to_frame(self) -> pd.DataFrame:
        """Return a row per component of theta: reference, mean of the estimates, its standard error, and their spread.

        ``std`` is the standard deviation of one estimate, and ``se`` that of the mean.
        """
        import pandas as pd

        repeats = len(self.values)
        std = self.values.std(axis=0, ddof=1) if repeats > 1 else np.full(self.reference.size, math.nan)
        columns = {"reference": self.reference, "mean": self.values.mean(axis=0), "se": std / math.sqrt(repeats)}
        return pd.DataFrame(columns | {"std": std}, index=pd.Index(component_names(self.problem), name="component"))
