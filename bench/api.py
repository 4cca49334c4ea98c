"""The Python interface: run an experiment, load stored rows, list plugins, compile a problem, estimate a gradient.

Names and settings are the same as on the command line.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack, cast

import numpy as np

from bench.errors import Unsupported, UserError, failure
from bench.experiment.by_name import compile_problem, make
from bench.model import Backend, Decision, Estimator, Integrator, Problem, Scene, registry
from bench.model.identity import label, text_of
from bench.model.parameters import build, parameters, singular
from bench.model.parameters import values as parameter_values
from bench.notebook import Estimates

if TYPE_CHECKING:
    import pandas as pd

Names = Sequence[str] | str
"""Identity strings of plugins, ``name`` or ``name[parameter=value]``: several, or one."""
Values = Mapping[str, Mapping[str, Any]]
"""Parameters of plugins: ``{"pushing": {"mass": 0.2}}``."""


class Settings(TypedDict, total=False):
    """The settings of an experiment, by their names on the command line; docs/commands.md has their meanings.

    A setting that is omitted has the value of the experiment's file, else the default of ``conf/config.yaml``.
    """

    name: str
    question: str
    answer: str
    study: str
    scenes: Names
    contacts: Names
    integrators: Names
    backends: Names
    estimators: Names
    optimizers: Names
    trainers: Names
    sweep: Mapping[str, Any]
    also: Names
    scene: Values
    contact: Values
    integrator: Values
    backend: Values
    estimator: Values
    optimizer: Values
    trainer: Values
    theta: Names
    theta0: Sequence[float] | np.ndarray | None
    descent: float
    path: Names
    samples: int
    repeats: int
    seed: int
    draws: str | None
    mirrored: bool | None
    reference: Mapping[str, float]
    workers: int | None
    timeout: float | str | None
    memory: float | str | None
    on_error: str
    ladder: bool
    retry: Names
    versions: str
    timing: bool | None
    compile_cache: str | Path | None
    plugins: str | Path | Sequence[str | Path]
    shard: str
    results_dir: str | Path
    formats: Names
    marks: Mapping[str, Mapping[str, float]]
    compares: Mapping[str, Sequence[Any]]


SIMPLE = re.compile(r"[A-Za-z0-9_./+-]*")
"""Strings that Hydra reads without quotes."""
SPECIAL, ESCAPED = re.compile(r"([\\()\[\]{}:=,])"), r"\\\1"
"""Characters that need a backslash in the keys of a Hydra table."""


def run(experiment: str | Sequence[str] = (), **settings: Unpack[Settings]) -> pd.DataFrame:
    """Run the missing cells of an experiment, write its tables and charts, and return its rows, one per cell.

    ``experiment`` is the name of an experiment, or a list of command-line words. ``settings`` are the keys of
    :class:`bench.api.Settings`: ``run("stiffness_sweep", samples=32, sweep={"stiffness": [1e2, 1e4]},
    results_dir="out")``. Parameters of plugins are nested dictionaries: ``scene={"pushing": {"mass": 0.2}}``. Raises
    :class:`bench.UserError` for invalid input.
    """
    from bench.experiment import config
    from bench.experiment.axes import with_axes
    from bench.report.finish import finish
    from bench.run.execute import execute

    words = [f"experiment={experiment}"] if isinstance(experiment, str) and experiment else list(experiment)
    words += [word for key, value in settings.items() for word in _override_words(key, value)]
    resolved = config.load(words)
    finished = execute(resolved)
    rows = finish(finished, words)[0] if resolved.execution.shard is None else finished.rows()
    return with_axes(resolved.sweep, rows).reset_index(drop=True)


def _override_words(key: str, value: Any) -> list[str]:
    """Return a keyword argument as command-line words. Dictionaries of plugin parameters become dotted keys."""
    kinds = registry.kinds()
    head = key.partition(".")[0]
    if isinstance(value, Mapping) and (head == "reference" or head in map(singular, kinds)):
        return [word for name, inner in value.items() for word in _override_words(f"{key}.{name}", inner)]
    return [f"{key}={_hydra_value(value, quoted=key not in (*kinds, 'path', 'study', 'experiment'))}"]


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

    from bench.experiment.axes import with_axes
    from bench.experiment.columns import Columns
    from bench.experiment.study import Study
    from bench.report.views import newest_rows
    from bench.run.rows import recorded_sweep
    from bench.run.store import Store

    directory = Path(directory).expanduser()
    rows = Store(directory, Columns.of()).load() if directory.is_dir() else pd.DataFrame()
    study = None if rows.empty else registry.entries()["studies"].get(str(rows["study"].iloc[0]))
    if study and study.plugin and issubclass(study.plugin, Study):
        rows = Store(directory, study.plugin.columns).load()  # without rows that the study cannot have stored
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
