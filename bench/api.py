"""The Python interface: run an experiment, load stored rows, list plugins, compile a problem, estimate a gradient.

Names and settings are the same as on the command line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from bench.errors import Unsupported, UserError, failure
from bench.experiment.by_name import compile_problem, make
from bench.host.identity import label, text_of
from bench.host.parameters import build, parameters, singular
from bench.host.parameters import values as parameter_values
from bench.model import Backend, Decision, Estimator, Integrator, Problem, Scene, registry
from bench.notebook import Estimates

if TYPE_CHECKING:
    import pandas as pd


def run(experiment: str | Sequence[str] = (), **settings: Any) -> pd.DataFrame:
    """Run the missing cells of an experiment, write its tables and charts, and return its rows, one per cell.

    ``experiment`` is the name of an experiment, or a list of command-line words. ``settings`` are those of the
    command line, see docs/commands.md: ``run("stiffness_sweep", samples=32, sweep={"stiffness": [1e2, 1e4]},
    results_dir="out")``. Parameters of plugins are nested dictionaries: ``scene={"pushing": {"mass": 0.2}}``. Raises
    :class:`bench.UserError` for invalid input.
    """
    from bench.experiment import config
    from bench.experiment.axes import with_axes
    from bench.report.finish import finish
    from bench.run.execute import execute

    words = [f"experiment={experiment}"] if isinstance(experiment, str) and experiment else list(experiment)
    resolved = config.load(words, settings=settings)
    finished = execute(resolved)
    texts = {key: value if isinstance(value, str) else config.as_json(key, value) for key, value in settings.items()}
    given = [*words, *(f"{key}={text}" for key, text in texts.items())]
    rows = finish(finished, given)[0] if resolved.execution.shard is None else finished.rows()
    return with_axes(resolved.whole_sweep, rows).reset_index(drop=True)


def load(directory: str | Path) -> pd.DataFrame:
    """Load an experiment's stored rows, one per cell, with a numeric column per axis that its last run swept.

    The column ``parameters`` contains every parameter of every plugin as JSON, with present defaults for parameters that
    a row lacks. Raises :class:`bench.UserError` if no rows are stored.
    """
    import pandas as pd

    from bench.experiment.axes import with_axes
    from bench.experiment.columns import Columns
    from bench.experiment.study import columns_of
    from bench.report.views import newest_rows
    from bench.run.rows import recorded_sweep
    from bench.run.store import Store

    directory = Path(directory).expanduser()
    rows = Store(directory, Columns.of()).load() if directory.is_dir() else pd.DataFrame()
    if not rows.empty:  # without rows that the study cannot have stored
        rows = Store(directory, columns_of(rows["study"].iloc[0])).load()
    if rows.empty:
        raise UserError(f"no rows are stored in '{directory}': run an experiment first, its folder is results_dir/name")
    return with_axes(recorded_sweep(directory), newest_rows(rows))


def list_plugins(*names: str, plugins: str | Path | Sequence[str | Path] = ()) -> pd.DataFrame:
    """List plugins, one per row: kind, name, what it is, its parameters with their defaults, and why it is unavailable.

    ``names`` are kinds (``"scenes"``) and names of plugins; without them, all plugins are listed. ``plugins`` are folders
    with your own plugins. Raises :class:`bench.UserError` for an unknown name.
    """
    import pandas as pd

    for folder in [plugins] if isinstance(plugins, str | Path) else plugins:
        registry.add_folder(Path(folder))
    rows = []
    for kind, listed in matching_plugins(names).items():
        for name, entry in sorted(listed.items()):
            declared = parameters(entry.plugin).values() if entry.plugin else ()
            texts = {parameter.name: text_of(parameter.default) for parameter in declared}
            rows.append((kind, name, described(entry, availability=False), texts, entry.available, entry.reason))
    return pd.DataFrame(rows, columns=["kind", "name", "description", "parameters", "available", "reason"])


def matching_plugins(names: Sequence[str]) -> registry.Table:
    """Return the plugins of the given kinds or names, or all plugins, by kind and name.

    Raises :class:`bench.UserError` for an unknown name.
    """
    table = registry.entries()
    kinds = {name: kind for kind in table for name in (kind, singular(kind))}
    known = {name for entries in table.values() for name in entries}
    for name in names:
        if name not in known and name not in kinds:
            raise registry.unknown_plugin("plugin or kind", name, {*known, *table}, "list")
    selected = {kinds[name] for name in names if name in kinds}
    return {
        kind: {name: e for name, e in entries.items() if not names or kind in selected or name in names}
        for kind, entries in table.items()
    }


def described(entry: registry.Entry, availability: bool = True) -> str:
    """Return the first line of a plugin's docstring and its capabilities; with ``availability``, why it is unavailable."""
    plugin = entry.plugin
    facts: list[str] = []
    if plugin is not None:
        facts.append((plugin.__doc__ or "").strip().split("\n")[0].rstrip("."))
        if issubclass(plugin, Backend):
            facts.append(f"provides {', '.join(sorted(plugin.provides))}")
        elif issubclass(plugin, Estimator):
            try:  # needs that depend on the parameters are a property
                needs = plugin.needs if isinstance(plugin.needs, frozenset) else plugin().needs
                facts.append(f"needs {', '.join(sorted(needs))}")
            except (Exception, SystemExit) as error:
                facts.append(f"UNAVAILABLE, {failure(error)['reason']}")
            if not plugin.unbiased:
                facts.append("biased at finite N")
            elif plugin.unbiased_at_discontinuities:
                facts.append("unbiased, across jumps too")
            else:
                facts.append("unbiased where the cost is continuous")
        elif issubclass(plugin, Integrator):
            facts.append(f"order {plugin.order}")
        elif issubclass(plugin, Scene) and plugin.neglected_effects:
            facts.append(f"leaves out {plugin.neglected_effects}")
    if availability and not entry.available:
        facts.append(f"UNAVAILABLE, {entry.reason}")
    return "; ".join(facts)


def problem(
    scene: str,
    contact: str = "penalty",
    integrator: str = "semi_implicit_euler",
    backend: str = "jax",
    theta: Sequence[str] = (),
    theta0: Sequence[float] | None = None,
    descent: float = 0.0,
    path: Sequence[str] = ("penalty", "semi_implicit_euler"),
) -> Problem:
    """Compile a problem by command-line names: ``problem("pushing[sigma=0.1]", contact="penalty[stiffness=1e4]")``.

    ``problem.value(theta, w)``, ``.grad`` and ``.score`` take ``theta (d,)`` or ``(d, B)`` and noise ``w (n_w,)`` or
    ``(n_w, B)``, as arrays or lists. By default they use ``problem.program.theta0``, the point at which gradients are
    taken, and no noise. ``problem.to_frame()`` has the parameters. ``theta``
    names float parameters of the scene and the contact law as the decision variable in place of the scene's own. With
    ``descent``, a share from 0 to below 1, ``theta0`` is where a descent that starts there has done this share of its gain,
    as in an experiment: ``path`` is what is descended, a contact law, an integrator and, if wanted, a backend. Raises
    :class:`bench.UserError` for an invalid name or value, and :class:`bench.Unsupported` if the combination cannot run
    or a library is not installed.
    """
    at = None if theta0 is None else tuple(map(float, theta0))
    decision = Decision(tuple(theta), at)
    if descent:
        from bench.experiment.grid import share_of
        from bench.measure.descent import descend

        share = share_of(descent)
        law, step, *engine = path
        start = compile_problem(scene, law, step, engine[0] if engine else None, decision)
        decision = Decision(decision.names, descend(start).at(share).theta)
    return compile_problem(scene, contact, integrator, backend, decision)


_problem = problem  # an argument of estimate has the same name


def estimate(
    problem: Problem | str,
    estimator: str,
    samples: int = 256,
    repeats: int = 64,
    seed: int = 0,
    reference_samples: int = 1 << 18,
    tolerance: float = 0.005,
    draws: str | None = None,
    mirrored: bool | None = None,
) -> Estimates:
    """Compute R = ``repeats`` independent estimates of grad J_sigma at ``theta0``, with their bias and variance.

    ``problem`` is compiled by :func:`problem`, or the name of a scene: ``estimate("pushing", "fobg")``. Each estimate
    uses N = ``samples`` samples. The noise is the same as in the cells of an experiment with this seed. The reference
    gradient is the closed form, quadrature or long sampling of the same problem, with up to ``reference_samples``
    samples, until its relative standard error is at most ``tolerance``. ``draws`` (``iid``, ``orthogonal``, ``sobol``) and
    ``mirrored`` choose how the samples of an estimate are drawn, as the parameters of the estimator do. Raises :class:`bench.Unsupported` if the
    estimator cannot be used on the problem.
    """
    from bench.measure import noise, reference, statistics

    if isinstance(problem, str):
        problem = _problem(problem)
    method: Estimator = make("estimators", estimator)
    given = {name: value for name, value in (("draws", draws), ("mirrored", mirrored)) if value is not None}
    method = cast(Estimator, build(type(method), parameter_values(method) | given))
    program = problem.program
    if reason := method.refusal(program, problem.provides, "this backend"):
        raise Unsupported(reason)
    w = noise.shared(seed, program.scene.name, repeats, samples, program.n_noise, method.design(program, samples))
    estimates, diagnostics = method.estimate_with_diagnostics(problem, program.theta0, w)
    values = np.asarray(estimates, dtype=np.float64)
    truth = reference.certify(problem, problem.provides, reference_samples, tolerance)
    if truth.is_finite:
        summary = statistics.summarise(values, truth.known(), samples, unbiased=method.declares_unbiased(program))
        summary = replace(summary, note="; ".join(part for part in (summary.note, truth.note) if part))
    else:
        summary = statistics.summarise_without_reference(values, samples, truth.note)
    return Estimates(problem, label(method), samples, values, truth.gradient, truth.method, summary, diagnostics)
