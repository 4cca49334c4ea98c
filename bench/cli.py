"""The verbs: run (the default), report, plan, list, check."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from bench.errors import UserError, unknown

if TYPE_CHECKING:
    from bench.grid import Cell, Experiment
    from bench.runner import Planned
    from bench.store import Store

HELP = """\
Compare gradient estimators through physics simulation.

  python -m bench +experiment=NAME [key=value ...]          run what is missing, then write tables and charts
  python -m bench report +experiment=NAME [key=value ...]   tables and charts again from stored rows
  python -m bench plan +experiment=NAME [key=value ...]     cells, how many are stored, expected time
  python -m bench list [NAME ...]                           plugins: parameters, capabilities, availability
  python -m bench check [NAME ...]                          the conformance kit on some plugins, or all

Experiments: {experiments}
Settings: scenes=[..] contacts=[..] integrators=[..] backends=[..] estimators=[..]
  sweep.AXIS=[..]  scene.NAME.PARAMETER=..  (also contact. integrator. backend. estimator.)
  samples=N repeats=R seed=S results_dir=DIR name=FOLDER

Exit status: 0 every cell has a row that is not 'error'; 1 some cell failed unexpectedly; 2 bad input.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return _dispatch(words)
    except UserError as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, the reader has gone; nothing may be written at exit
        return 0
    except KeyboardInterrupt:
        again = " ".join(["python -m bench", *words])
        print(f"\nbench: stopped; finished cells are stored, go on with: {again}", file=sys.stderr)
        return 130


def _dispatch(words: list[str]) -> int:
    verbs: dict[str, Callable[[list[str]], int]] = {
        "run": _run,
        "report": _report,
        "plan": _plan,
        "list": _list,
        "check": _check,
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
    from bench import config, runner, studies
    from bench.store import Store

    experiment = config.load(words)
    store = Store(experiment.directory, studies.find(experiment.study).COLUMNS)
    return experiment, store, runner.plan(experiment, store)


def _run(words: list[str]) -> int:
    import time

    from bench import runner
    from bench.report import progress

    experiment, store, planned = _prepare(words)
    started = time.time()
    waiting = [item for item in planned if not item.stored]
    store.prepare()
    with progress.bar(experiment.name, len(planned), len(planned) - len(waiting)) as advance:

        def watch(cell: Cell, row: dict[str, Any]) -> None:
            advance(row)

        try:
            runner.run(experiment, planned, store, watch)
        finally:
            store.compact()
    return _write(experiment, store, words, time.time() - started, [item.cell.key for item in planned])


def _report(words: list[str]) -> int:
    from bench import config, studies
    from bench.store import Store

    experiment = config.load(words)
    store = Store(experiment.directory, studies.find(experiment.study).COLUMNS)
    return _write(experiment, store, words, 0.0, None)


def _write(experiment: Experiment, store: Store, words: list[str], seconds: float, keys: list[str] | None) -> int:
    from bench import grid, report, studies

    rows = store.load()
    if keys is not None:
        order = {key: index for index, key in enumerate(keys)}
        rows = rows[rows["key"].isin(keys)].sort_values("key", key=lambda k: k.map(order)).reset_index(drop=True)
    else:
        rows = report.latest(rows)
    if rows.empty:
        raise UserError(f"no rows are stored in '{store.directory}': run the experiment first")
    paths = studies.find(experiment.study).write(experiment, rows, grid.swept(experiment.sweep))
    if seconds:
        paths.append(report.record(experiment, rows, words, seconds))
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


def _check(words: list[str]) -> int:
    from bench import conformance, registry

    known = {name for table in registry.entries().values() for name in table}
    for word in words:
        if word not in known:
            raise unknown("plugin", word, known)
    return conformance.main(words)
