"""The verbs: run (the default), report, plan, list, check, gradcheck, trace."""

from __future__ import annotations

import itertools
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from bench.errors import StorageError, UserError, unknown

if TYPE_CHECKING:
    from bench.grid import Experiment
    from bench.runner import Planned
    from bench.store import Store

HELP = """\
Compare gradient estimators through physics simulation.

  python -m bench +experiment=NAME [key=value ...]          run what is missing, then write tables and charts
  python -m bench report +experiment=NAME [key=value ...]   tables and charts again from stored rows
  python -m bench plan +experiment=NAME [key=value ...]     cells, how many are stored, expected time
  python -m bench list [NAME ...]                           plugins: parameters, capabilities, availability
  python -m bench check [NAME ...]                          the conformance kit on some plugins, or all
  python -m bench gradcheck SCENE ... [key=value ...]       gradients against differences of the cost, and what is wrong
  python -m bench trace SCENE ... [key=value ...]           one rollout: do gradient spikes line up with contact switches?
  python -m bench bench-self [quick=true]                   the harness's own speed, beside a NumPy loop and native code
  python -m bench compare BEFORE AFTER [--timings]          two results, cell by cell: 1 when something got worse

Experiments: {experiments}
Settings: scenes=[..] contacts=[..] integrators=[..] backends=[..] estimators=[..]
  sweep.AXIS=[..]  scene.NAME.PARAMETER=..  (also contact. integrator. backend. estimator.)
  samples=N repeats=R seed=S results_dir=DIR name=FOLDER

  workers=N timeout=10m memory=4g on_error=stop timing=false retry=[timeout]    --quiet: no progress

Exit status: 0 every cell has a row that is not 'error'; 1 some cell failed unexpectedly; 2 bad input.
"""

QUIET = "--quiet"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return _dispatch(words)
    except UserError as error:
        print("bench:", " ".join(str(error).split()), file=sys.stderr)
        return 2
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, the reader has gone; nothing may be written at exit
        return 0
    except OSError as error:
        where = f"'{error.filename}': " if error.filename else ""
        print(f"bench: {where}{error.strerror or error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nbench: stopped", file=sys.stderr)
        return 130


def _dispatch(words: list[str]) -> int:
    verbs: dict[str, Callable[[list[str]], int]] = {
        "run": _run,
        "report": _report,
        "plan": _plan,
        "list": _list,
        "check": _check,
        "gradcheck": _gradcheck,
        "trace": _trace,
        "bench-self": _bench_self,
        "compare": _compare,
    }
    if not words or words[0] in ("-h", "--help", "help"):
        from bench import config

        print(HELP.format(experiments=", ".join(config.experiments())), end="")
        return 0 if words else 2
    verb = "run"
    if "=" not in words[0]:
        verb = words.pop(0)
    if verb in ("-m", "--multirun"):
        raise UserError("one run is one experiment, and its grid is expanded by bench itself: leave out --multirun")
    if verb not in verbs:
        raise unknown("command", verb, verbs)
    return verbs[verb](words)


# ------------------------------------------------------------------------------------------------------ run


def _prepare(words: list[str]) -> tuple[Experiment, Store, list[Planned]]:
    from bench import config

    overrides = [word for word in words if word != QUIET]
    experiment = config.load(overrides)
    for note in config.notes(overrides):
        print(f"bench: {note}", file=sys.stderr)
    return _planned(experiment)


def _planned(experiment: Experiment) -> tuple[Experiment, Store, list[Planned]]:
    from bench import runner, studies
    from bench.store import Store

    store = Store(experiment.directory, studies.find(experiment.study).COLUMNS)
    return experiment, store, runner.plan(experiment, store)


def _run(words: list[str]) -> int:
    return _execute(*_prepare(words), words)


def _execute(experiment: Experiment, store: Store, planned: list[Planned], words: list[str]) -> int:
    import time

    from bench import runner, timing
    from bench.report import progress

    started = time.time()
    timing.load_at_start()
    if experiment.compile_cache:
        os.environ["BENCH_COMPILE_CACHE"] = str(experiment.compile_cache)
    progress.print_versions(planned, experiment.execution.versions)
    store.prepare()
    with progress.of(experiment.name, planned, QUIET in words) as shown:
        try:
            runner.run(experiment, planned, store, shown.finished, shown.working)
        except (KeyboardInterrupt, runner.Stopped) as end:
            return _ended(end, store, planned, words)
        finally:
            _compact(store, planned)
    return _write(experiment, store, words, time.time() - started, planned)


def _ended(end: BaseException, store: Store, planned: list[Planned], words: list[str]) -> int:
    """Say why a run has ended early, what is stored and how to go on."""
    keys = {item.cell.key for item in planned}
    stored = int(store.load()["key"].isin(keys).sum())
    why = "stopped" if isinstance(end, KeyboardInterrupt) else f"stopped after a failed cell ({end})"
    again = shlex.join(["python", "-m", "bench", *words])
    print(
        f"\nbench: {why}; {stored} of {len(keys)} cells are stored in '{store.directory}', go on with: {again}",
        file=sys.stderr,
    )
    return 130 if isinstance(end, KeyboardInterrupt) else 1


def _compact(store: Store, planned: list[Planned]) -> None:
    """Fold small files; a full disk is no reason to hide why a run has ended, and the rows are read from them as well."""
    try:
        store.compact([item.cell.key for item in planned])
    except StorageError as error:
        print(f"bench: {error}; every finished cell is stored all the same", file=sys.stderr)


def _report(words: list[str]) -> int:
    from bench import config, studies
    from bench.store import Store

    experiment = config.load(words)
    store = Store(experiment.directory, studies.find(experiment.study).COLUMNS)
    return _write(experiment, store, words, 0.0, None)


def _write(
    experiment: Experiment, store: Store, words: list[str], seconds: float, planned: list[Planned] | None
) -> int:
    """Tables and charts, of the planned cells in their order or of all that is stored."""
    from bench import grid, report, studies
    from bench.report import web
    from bench.store import ordered

    rows = store.load()
    if planned is None:
        rows = report.latest(rows)
    else:
        keys = [item.cell.key for item in planned]
        rows = ordered(rows[rows["key"].isin(keys)], keys)
    if rows.empty:
        raise UserError(f"no rows are stored in '{store.directory}': run the experiment first")
    axes = grid.swept(experiment.sweep)
    paths = studies.find(experiment.study).write(experiment, rows, axes)
    if seconds:
        simulated = planned is None or any(item.runs for item in planned)
        paths.append(report.record(experiment, rows, words, seconds, simulated))
    paths.append(web.write(experiment, rows, axes))
    print("\nWritten:")
    for path in paths:
        print(f"  {path}")
    return 1 if (rows["status"] == "error").any() else 0


# ----------------------------------------------------------------------------------------------------- plan


def _plan(words: list[str]) -> int:
    from bench.report import progress

    experiment, store, planned = _prepare(words)
    progress.print_plan(experiment, planned, store.load())
    return 0


# ----------------------------------------------------------------------------------------------------- list


def _list(words: list[str]) -> int:
    from bench import registry

    known = {name for table in registry.entries().values() for name in table}
    for word in words:
        if word not in known:
            raise unknown("plugin", word, known)
    for kind, table in registry.entries().items():
        chosen = {name: entry for name, entry in table.items() if not words or name in words}
        if chosen:
            print(f"\n{kind}")
        for name, entry in sorted(chosen.items()):
            print(f"  {name:<22}{_facts(entry)}")
            if entry.plugin is None:
                continue
            for parameter in registry.parameters(entry.plugin).values():
                unit = f" [{parameter.unit}]" if parameter.unit else ""
                choices = f" ({' | '.join(parameter.choices)})" if parameter.choices else ""
                value = registry.identity("", {"": parameter.default})[2:-1]
                print(f"      {parameter.name}={value}{unit}  {parameter.doc}{choices}")
    return 0


def _facts(entry: Any) -> str:
    from bench.contracts import Backend, Estimator, Integrator, Scene

    plugin = entry.plugin
    if plugin is None:
        return f"UNAVAILABLE, {entry.reason}"
    facts = [(plugin.__doc__ or "").strip().split("\n")[0]]
    if issubclass(plugin, Backend):
        facts.append(f"provides {', '.join(sorted(plugin.provides))}")
    elif issubclass(plugin, Estimator):
        facts.append(f"needs {', '.join(sorted(plugin.needs))}")
        facts.append("unbiased" + (", across jumps too" if plugin.across_jumps else " where the cost is continuous"))
        if not plugin.unbiased:
            facts[-1] = "biased at finite N"
    elif issubclass(plugin, Integrator):
        facts.append(f"order {plugin.order}")
    elif issubclass(plugin, Scene) and plugin.leaves_out:
        facts.append(f"leaves out {plugin.leaves_out}")
    if not entry.available:
        facts.append(f"UNAVAILABLE, {entry.reason}")
    return "; ".join(facts)


# ---------------------------------------------------------------------------------------------------- check


def _bench_self(words: list[str]) -> int:
    from bench import benchself

    return benchself.main(words)


def _check(words: list[str]) -> int:
    from bench import conformance, registry

    known = {name for table in registry.entries().values() for name in table}
    for word in words:
        if word not in known:
            raise unknown("plugin", word, known)
    return conformance.main(words)


# ------------------------------------------------------------------------------------------------ gradcheck


def _gradcheck(words: list[str]) -> int:
    """The experiment ``gradient_check`` on the scenes named first, under the overrides that follow; 1 for a fault too."""
    from dataclasses import replace

    from bench import config, registry
    from bench.report import gradient_check

    scenes = list(itertools.takewhile(lambda word: "=" not in word.partition("[")[0], words))
    chosen = [f"scenes=[{','.join(scenes)}]", "name=gradcheck"] if scenes else []
    experiment = config.load(["experiment=gradient_check", *chosen, *words[len(scenes) :]])
    plugins = [choice.entry.plugin for choice in experiment.choices["scenes"]]
    if not any(plugin and "horizon" in registry.parameters(plugin) for plugin in plugins):
        experiment = replace(experiment, sweep={k: v for k, v in experiment.sweep.items() if k != "horizon"})
    experiment, store, planned = _planned(experiment)
    status = _execute(experiment, store, planned, ["gradcheck", *words])
    rows = store.load()
    return 1 if status or gradient_check.failed(rows[rows["key"].isin([p.cell.key for p in planned])]) else 0


# ---------------------------------------------------------------------------------------------------- trace


def _trace(words: list[str]) -> int:
    """One rollout of each scene named first: w = 0, or a sample of the noise where ``seed=`` is among the overrides."""
    from bench import config, health
    from bench.report import trace

    scenes = list(itertools.takewhile(lambda word: "=" not in word.partition("[")[0], words))
    if not scenes:
        raise UserError("name a scene to trace: python -m bench trace SCENE ... [key=value ...]")
    overrides = words[len(scenes) :]
    experiment = config.load([f"scenes=[{','.join(scenes)}]", *overrides])
    for found in health.run(experiment, any(word.startswith("seed=") for word in overrides)):
        print(f"\n{found.title}")
        for sentence in found.report():
            print(f"  {sentence}")
        print("Written:")
        for path in trace.write(found, experiment.results_dir):
            print(f"  {path}")
    return 0


# ------------------------------------------------------------------------------------------------------ compare


def _compare(words: list[str]) -> int:
    """Two directories of results, or two revisions of them in git, cell by cell."""
    from bench.report import compare

    return compare.main(words)
