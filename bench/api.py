"""The Python interface: run an experiment, load stored rows, compile a problem, estimate a gradient.

Names and settings are the same as on the command line.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.errors import Unsupported, UserError
from bench.experiment.by_name import compile_problem, make
from bench.model import Decision, Estimator, Problem, registry
from bench.model.parameters import singular

if TYPE_CHECKING:
    import pandas as pd

    from bench.measure.statistics import Summary

SIMPLE = re.compile(r"[A-Za-z0-9_./+-]*")
"""Strings that Hydra reads without quotes."""
SPECIAL, ESCAPED = re.compile(r"([\\()\[\]{}:=,])"), r"\\\1"
"""Characters that need a backslash in the keys of a Hydra table."""


def run(experiment: str | Sequence[str] = (), **overrides: Any) -> pd.DataFrame:
    """Run the missing cells of an experiment, write its tables and charts, and return its rows, one per cell.

    ``experiment`` is the name of an experiment, or a list of command-line words. ``overrides`` are settings:
    ``run("stiffness_sweep", samples=32, sweep={"stiffness": [1e2, 1e4]}, results_dir="out")``. Parameters of plugins are
    nested dictionaries: ``scene={"pushing": {"mass": 0.2}}``. Raises :class:`bench.UserError` for invalid input.
    """
    from bench.experiment import config
    from bench.experiment.axes import with_axes
    from bench.report.finish import finish
    from bench.run.execute import execute

    words = [f"experiment={experiment}"] if isinstance(experiment, str) and experiment else list(experiment)
    words += [word for key, value in overrides.items() for word in _override_words(key, value)]
    resolved = config.load(words)
    rows, _ = finish(execute(resolved), words)
    return with_axes(resolved, rows).reset_index(drop=True)


def _override_words(key: str, value: Any) -> list[str]:
    """Return a keyword argument as command-line words. Dictionaries of plugin parameters become dotted keys."""
    kinds = registry.kinds()
    head = key.partition(".")[0]
    if isinstance(value, Mapping) and (head == "reference" or head in map(singular, kinds)):
        return [word for name, inner in value.items() for word in _override_words(f"{key}.{name}", inner)]
    return [f"{key}={_hydra_value(value, quoted=key not in (*kinds, 'study', 'experiment'))}"]


def _hydra_value(value: Any, quoted: bool = True) -> str:
    """Return a value in Hydra's grammar. Identity strings stay unquoted, since the code that reads them quotes them."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        items = ((SPECIAL.sub(ESCAPED, str(name)), _hydra_value(inner, quoted)) for name, inner in value.items())
        return "{" + ",".join(f"{name}:{inner}" for name, inner in items) + "}"
    if isinstance(value, str | Path):
        if not quoted or SIMPLE.fullmatch(str(value)):
            return str(value)
        # Hydra reads backslashes literally, except before a quote and at the end
        escaped = re.sub(r"(\\*)('|$)", lambda match: 2 * match[1] + ("\\'" if match[2] else ""), str(value))
        return f"'{escaped}'"
    if isinstance(value, list | tuple | range):
        return "[" + ",".join(_hydra_value(one, quoted) for one in value) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)


def load(directory: str | Path) -> pd.DataFrame:
    """Load an experiment's stored rows, one per cell, with a numeric column per axis that its last run swept.

    The column ``parameters`` contains every parameter of every plugin as JSON, with present defaults for parameters that
    a row lacks. Raises :class:`bench.UserError` if no rows are stored.
    """
    import pandas as pd

    from bench.experiment import axes
    from bench.experiment.columns import Columns
    from bench.experiment.defaults import completed_rows
    from bench.experiment.study import Study
    from bench.report.views import newest_rows
    from bench.run.store import Store

    directory = Path(directory).expanduser()
    rows = Store(directory, Columns.of()).load() if directory.is_dir() else pd.DataFrame()
    if rows.empty:
        raise UserError(f"no rows are stored in '{directory}': run an experiment first, its folder is results_dir/name")
    study = registry.entries()["studies"].get(str(rows["study"].iloc[0]))
    columns = study.plugin.columns if study and study.plugin and issubclass(study.plugin, Study) else Columns.of()
    rows = completed_rows(newest_rows(columns.typed(rows)))
    try:
        sweep = json.loads((directory / "run.json").read_text())["config"]["sweep"]
    except (OSError, ValueError, KeyError, TypeError):
        sweep = {}
    swept_axes = axes.axes(sweep, rows)
    return rows.assign(**{axis.column: axes.values_of(axis, rows) for axis in swept_axes if axis.column not in rows})


def problem(
    scene: str,
    contact: str = "penalty",
    integrator: str = "semi_implicit_euler",
    backend: str = "jax",
    theta: Sequence[str] = (),
    theta0: Sequence[float] | None = None,
) -> Problem:
    """Compile a problem by command-line names: ``problem("pushing[sigma=0.1]", contact="penalty[stiffness=1e4]")``.

    ``problem.value(theta, w)``, ``.grad`` and ``.score`` take ``theta (d,)`` or ``(d, B)`` and noise ``w (n_w, B)``.
    ``problem.program.theta0`` is the point at which gradients are taken. ``theta`` names float parameters of the scene
    and the contact law as the decision variable in place of the scene's own. Raises :class:`bench.UserError` for an
    invalid name or value, and :class:`bench.Unsupported` if the combination cannot run or a library is not installed.
    """
    at = None if theta0 is None else tuple(map(float, theta0))
    return compile_problem(scene, contact, integrator, backend, Decision(tuple(theta), at))


@dataclass(frozen=True, eq=False)
class Estimates:
    """Independent estimates of a gradient, compared with the reference gradient."""

    values: np.ndarray
    """The estimates, ``(R, d)``."""
    reference: np.ndarray
    """The reference gradient, ``(d,)``."""
    reference_method: str
    summary: Summary
    """Bias and variance with 95% intervals, see :class:`bench.measure.statistics.Summary`."""
    auxiliaries: Mapping[str, np.ndarray]
    """Diagnostics of the estimator by name, such as a weight, each ``(R,)`` or ``(R, d)``."""

    def __str__(self) -> str:
        s = self.summary
        return (
            f"{len(self.values)} estimates: bias {s.bias:.3g} [{s.bias_low:.3g}, {s.bias_high:.3g}], variance {s.variance:.3g} "
            f"[{s.variance_low:.3g}, {s.variance_high:.3g}], rmse {s.rmse:.3g}, |reference| {s.reference_norm:.3g} "
            f"({self.reference_method})" + (f"; {s.note}" if s.note else "")
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the statistics by the names of the main table's columns."""
        return asdict(self.summary)


def estimate(
    problem: Problem,
    estimator: str,
    samples: int = 256,
    repeats: int = 64,
    seed: int = 0,
    reference_samples: int = 1 << 18,
    tolerance: float = 0.005,
) -> Estimates:
    """Compute R = ``repeats`` independent estimates of grad J_sigma at ``theta0``, with their bias and variance.

    Each estimate uses N = ``samples`` samples. The noise is the same as in the cells of an experiment with this seed. The
    reference gradient is the closed form, quadrature or long sampling of the same problem, with up to
    ``reference_samples`` samples, until its relative standard error is at most ``tolerance``. Raises
    :class:`bench.Unsupported` if the estimator cannot be used on the problem.
    """
    from bench.measure import noise, reference, statistics

    method: Estimator = make("estimators", estimator)
    program = problem.program
    if reason := method.incompatibility(program, problem.provides, "this backend"):
        raise Unsupported(reason)
    w = noise.shared(seed, program.scene.name, repeats, samples, program.n_noise)
    estimates, diagnostics = method.estimate_with_diagnostics(problem, program.theta0, w)
    values = np.asarray(estimates, dtype=np.float64)
    truth = reference.certify(problem, problem.provides, reference_samples, tolerance)
    unbiased = method.declares_unbiased(program)
    summary = statistics.summarise(values, truth.known(), samples, unbiased=unbiased)
    summary = replace(summary, note="; ".join(part for part in (summary.note, truth.note) if part))
    return Estimates(values, truth.gradient, truth.method, summary, diagnostics)
