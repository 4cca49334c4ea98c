"""The Python face: run an experiment, load stored rows, build a problem, estimate a gradient.

Everything here takes the same names as the command line, and the command line is a thin layer over it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.errors import UserError
from bench.model import Backend, Decision, Estimator, MechanicalScene, Problem, compose, registry
from bench.model.identity import parse_identity
from bench.model.parameters import build, parameters, singular

if TYPE_CHECKING:
    import pandas as pd

    from bench.measure.statistics import Summary

SIMPLE = re.compile(r"[A-Za-z0-9_./+-]*")
"""Strings that Hydra takes as they are."""


def run(experiment: str | Sequence[str] = (), **overrides: Any) -> pd.DataFrame:
    """Run the missing cells of an experiment, write its tables and charts, and return its rows, one per cell.

    ``experiment`` is the name of one of the experiments, or words as on the command line. ``overrides`` are settings:
    ``run("stiffness_sweep", samples=32, sweep={"stiffness": [1e2, 1e4]}, results_dir="out")``. Nested plugin parameters
    are given as tables: ``scene={"pushing": {"mass": 0.2}}``. Raises :class:`bench.UserError` for bad input.
    """
    from bench.experiment import config
    from bench.experiment.axes import with_axes
    from bench.report.finish import finish
    from bench.run.execute import execute

    words = [f"experiment={experiment}"] if isinstance(experiment, str) and experiment else list(experiment)
    words += [word for key, value in overrides.items() for word in _words(key, value)]
    resolved = config.load(words)
    rows, _ = finish(execute(resolved), words)
    return with_axes(resolved, rows).reset_index(drop=True)


def _words(key: str, value: Any) -> list[str]:
    """Turn a keyword into command-line words; tables of plugin parameters become dotted keys."""
    kinds = registry.kinds()
    head = key.partition(".")[0]
    if isinstance(value, Mapping) and (head == "reference" or head in map(singular, kinds)):
        return [word for name, inner in value.items() for word in _words(f"{key}.{name}", inner)]
    return [f"{key}={_text(value, quoted=key not in (*kinds, 'study', 'experiment'))}"]


def _text(value: Any, quoted: bool = True) -> str:
    """Write a value in Hydra's grammar; identity strings are quoted by the code that reads them."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{_key(name)}:{_text(inner, quoted)}" for name, inner in value.items()) + "}"
    if isinstance(value, str | Path):
        if not quoted or SIMPLE.fullmatch(str(value)):
            return str(value)
        # Hydra takes backslashes literally, except before a quote and at the end
        escaped = re.sub(r"(\\*)('|$)", lambda match: 2 * match[1] + ("\\'" if match[2] else ""), str(value))
        return f"'{escaped}'"
    if isinstance(value, list | tuple | range):
        return "[" + ",".join(_text(one, quoted) for one in value) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)


def _key(name: Any) -> str:
    return re.sub(r"([\\()\[\]{}:=,])", r"\\\1", str(name))


def load(directory: str | Path) -> pd.DataFrame:
    """Load an experiment's stored rows, one per cell, with a numeric column per axis that its last run swept.

    The column ``parameters`` has every parameter of every plugin as JSON. Raises :class:`bench.UserError` where there
    are no rows.
    """
    import pandas as pd

    from bench.experiment import axes
    from bench.experiment.columns import Columns
    from bench.experiment.study import Study
    from bench.report.views import latest
    from bench.run.store import Store

    directory = Path(directory).expanduser()
    rows = Store(directory, Columns.of()).load() if directory.is_dir() else pd.DataFrame()
    if rows.empty:
        raise UserError(f"no rows are stored in '{directory}': run an experiment first, its folder is results_dir/name")
    study = registry.entries()["studies"].get(str(rows["study"].iloc[0]))
    columns = study.plugin.columns if study and study.plugin and issubclass(study.plugin, Study) else Columns.of()
    rows = latest(columns.typed(rows))
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

    ``problem.value(theta, w)``, ``.grad`` and ``.score`` take ``theta (d,)`` or ``(d, B)`` and noise ``w (n_w, B)``;
    ``problem.program.theta0`` is where the scene's gradients are taken. ``theta`` names float parameters of scene and
    contact law as the decision variable instead of the scene's own. Raises :class:`bench.UserError` for a bad name or
    value and :class:`bench.Unsupported` for a combination that cannot run.
    """
    from bench.errors import Unsupported

    chosen = _made("scenes", scene)
    law = step = None
    if isinstance(chosen, MechanicalScene):
        law = _made("contacts", contact, chosen.contact_values) if chosen.n_contacts else None
        step = _made("integrators", integrator)
    at = None if theta0 is None else tuple(map(float, theta0))
    program = compose(chosen, law, step, Decision(tuple(theta), at))
    engine: Backend = _made("backends", backend)
    if reason := engine.incompatibility(program):
        raise Unsupported(reason)
    compiled = engine.compile(program)
    compiled.provides = engine.provides
    return compiled


def _made(kind: str, text: str, given: Mapping[str, Any] | None = None) -> Any:
    name, values = parse_identity(text)
    plugin = registry.usable(kind, name)
    entry = registry.find(kind, name)
    if not entry.available:
        raise UserError(f"{kind} {name} is {entry.reason}")
    declared = parameters(plugin)
    return build(plugin, {k: v for k, v in (given or {}).items() if k in declared} | values)


@dataclass(frozen=True, eq=False)
class Estimates:
    """Independent estimates of a gradient, and how they compare with the reference."""

    values: np.ndarray
    """``(R, d)``."""
    reference: np.ndarray
    """The reference gradient, ``(d,)``."""
    reference_method: str
    summary: Summary
    """Bias, variance and their 95% intervals; see :class:`bench.measure.statistics.Summary`."""
    auxiliaries: Mapping[str, np.ndarray]
    """What the estimator reports of itself by name, a weight for example: ``(R,)`` or ``(R, d)``."""

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
    """Make R independent estimates of grad J_sigma at ``theta0`` from N samples each, with bias, variance, intervals.

    The noise is that of a sweep's cells with this seed. The reference gradient is the closed form, quadrature or long
    sampling of the same problem, with up to ``reference_samples`` samples. Raises :class:`bench.Unsupported` where the
    estimator cannot be used on the problem.
    """
    from bench.errors import Unsupported
    from bench.measure import noise, reference, statistics

    method: Estimator = _made("estimators", estimator)
    program = problem.program
    if reason := method.incompatibility(program, problem.provides, "this backend"):
        raise Unsupported(reason)
    w = noise.shared(seed, program.scene.name, repeats, samples, program.n_noise)
    estimates, decided = method.estimate_with_diagnostics(problem, program.theta0, w)
    values = np.asarray(estimates, dtype=np.float64)
    truth = reference.certify(problem, problem.provides, reference_samples, tolerance)
    unbiased = method.declares_unbiased(program)
    summary = statistics.summarise(values, truth.known(), samples, unbiased=unbiased)
    summary = replace(summary, note="; ".join(part for part in (summary.note, truth.note) if part))
    return Estimates(values, truth.gradient, truth.method, summary, decided)
