"""The commands of ``python -m bench``: parses their words and calls the modules that do the work."""

from __future__ import annotations

import importlib
import itertools
import os
import re
import shlex
import signal
import sys
import textwrap
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bench.errors import INTERRUPTED, UserError, needing_sweeps, printable, unknown

if TYPE_CHECKING:
    import pandas as pd

    from bench.experiment.experiment import Experiment
    from bench.experiment.views import Views
    from bench.run.execute import Finished

SETTINGS = """\
Settings:
  scenes=[..] contacts=[..] integrators=[..] backends=[..] estimators=[..]
  study=NAME sweep.AXIS=[..] theta=[mass,..] theta0=[..] descent=0.9
  scene.NAME.PARAMETER=..  (also contact. integrator. backend. estimator.)
  samples=N repeats=R seed=S results_dir=DIR name=FOLDER formats=[png,svg,pdf]
  workers=N timeout=10m memory=4g on_error=stop timing=false retry=[timeout]
  shard=3/64: the third of 64 parts of the sweep
  plugins=DIR: plugins of your own
  --config-dir DIR: experiments of your own, as DIR/experiment/NAME.yaml
  --quiet: no progress
"""
STATUS = """\
Exit status: 0 every cell has a row that is not 'error'; 1 some cell failed
unexpectedly; 2 bad input.
"""
EXAMINE = """\
  theta=1,0            the point: numbers, names with numbers (mass:1,gain:2), or a name in the file; by default theta
  grad=jax             jax, torch, or a function: a name in the file, or FILE:NAME; without it, only differences
  sigma=0.003,0.05     standard deviations of noise on theta; by input: sigma=mass:0.1,gain:0.2
  noise=200            the cost is cost(theta, w), with w of that many standard normal numbers
  budget=60s           time for the whole examination
  calls=500            number of costs and gradients; only with calls=, the report is the same on any machine
  compile_budget=300s  time for the first calls, which may compile
  tolerance=1e-4       relative error that only causes a warning; by input: tolerance=mass:1e-3; absolute: atol=1e-9
  allow_zero=friction  inputs that may have no effect; true: all, false: none
  expect=kink          the known cause, with which the status is 0
  baseline=FILE        status 0 unless something is worse than in this file, which is written if absent and the status 0
  --bench-update       write the baseline
  refined=NAME         the cost at a tighter tolerance or finer step
  horizons=1,2,10      numbers of steps T: cost(theta, steps=T) and its gradient
  batch=loop           batching of thetas: loop, vmap, columns (d, B), rows (B, d), columns:64; by default detected
  scale=1,0.1          the typical size of each input; by default its value
  seed=0               of the random directions and noise
  save=DIR             write text, tables and charts there
  --quiet              no progress
Exit status: 0 right; 1 wrong; 3 not decided; 2 bad input.
"""
FAMILY = """\
Three commands ask whether something is right, each about its own subject:
  check      a plugin: does it do what it declares?
  gradcheck  a scene: is each gradient the derivative of its program?
  examine    your own simulator: is its gradient right, and what to use?
"""
QUIET, CONFIG_DIR = "--quiet", "--config-dir"


@dataclass(frozen=True)
class Verb:
    """One command."""

    call: Callable[[list[str]], int]
    usage: str
    does: str
    more: str = ""
    """Text that ``--help`` adds."""
    group: str = "Results"
    """Heading under which the overview lists the command."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command. Returns the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _stop_on_signals(), needing_sweeps(" ".join(["bench", *words[:1]])):
            return _dispatch(words)
    except UserError as error:
        print("bench:", printable(error), file=sys.stderr)
        return 2
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, the reader is closed, and writing at exit would fail
        return 128 + signal.SIGPIPE
    except OSError as error:
        where = f"'{printable(error.filename)}': " if error.filename else ""
        print(f"bench: {where}{error.strerror or printable(error)}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        if "home directory" not in str(error):  # the message of pathlib for ~ and ~name
            raise
        print("bench: a folder starts with ~ and an unknown user name", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nbench: stopped", file=sys.stderr)
        return 130


@contextmanager
def _stop_on_signals() -> Iterator[None]:
    """Make SIGTERM and SIGHUP stop a command like Ctrl-C; further signals are ignored, and left to the parent process.

    No finished row is lost, since rows are on disk and workers end with their run. In a finaliser or a callback of the
    garbage collector, such as JAX's, Python would print the KeyboardInterrupt and continue: it is not printed there, and
    since ``INTERRUPTED`` is set, the run stops after the current cell.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    names = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]

    def stop(*_: object) -> None:
        for name in names:
            signal.signal(name, signal.SIG_IGN)
        INTERRUPTED.set()
        raise KeyboardInterrupt

    def hide_interrupt(unraisable: sys.UnraisableHookArgs, /) -> None:
        if not (unraisable.exc_type is KeyboardInterrupt and INTERRUPTED.is_set()):
            previous_hook(unraisable)

    previous_hook = sys.unraisablehook
    sys.unraisablehook = hide_interrupt
    handlers = {name: signal.getsignal(name) for name in names}
    for name in names:
        if handlers[name] not in (signal.SIG_IGN, None):  # ignored signals stay ignored, as under nohup
            signal.signal(name, stop)
    try:
        yield
    finally:
        INTERRUPTED.clear()
        if sys.unraisablehook is hide_interrupt:
            sys.unraisablehook = previous_hook
        for name, handler in handlers.items():
            if signal.getsignal(name) is stop:
                signal.signal(name, handler)


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        _print_overview()
        return 0 if words else 2
    if words[0] == "-V" or "--version" in words:
        from bench import __version__

        print(f"bench {__version__}")
        return 0
    verb = "run"
    if "=" not in words[0] and not words[0].startswith("-"):
        verb = words.pop(0)
    if words[:1] in (["-m"], ["--multirun"]):
        raise UserError("one run is one experiment, and bench expands its grid: leave out --multirun")
    if verb not in VERBS:
        from bench.experiment import config

        if verb in config.experiments():
            raise UserError(
                f"'{verb}' is an experiment: {shlex.join(['python', '-m', 'bench', f'+experiment={verb}', *words])}"
            )
        raise unknown("command", verb, VERBS)
    if any(word in ("-h", "--help") for word in words):
        command = VERBS[verb]
        print(f"python -m bench {command.usage}\n\n{command.does}\n{command.more and chr(10) + command.more}", end="")
        return 0
    return VERBS[verb].call(words)


def _print_overview() -> None:
    from bench.experiment import config

    groups = dict.fromkeys(verb.group for verb in VERBS.values())
    listed = {
        group: "".join(f"\n  {verb.usage}\n      {verb.does}" for verb in VERBS.values() if verb.group == group)
        for group in groups
    }
    parts = [
        "python -m bench COMMAND: compare gradient estimators through physics simulation.",
        *(f"{group}{lines}" for group, lines in listed.items()),
        textwrap.fill(f"Each takes --help. Experiments: {', '.join(config.experiments())}", 79),
        SETTINGS,
        STATUS,
    ]
    print("\n\n".join(part.rstrip("\n") for part in parts))


# ------------------------------------------------------------------------------------------------------ run


def _load(words: Sequence[str]) -> Experiment:
    """Return the experiment that the words describe."""
    from bench.experiment import config

    overrides, folders = [], []
    rest = iter(word for word in words if word != QUIET)
    for word in rest:
        name, equals, value = word.partition("=")
        if name == CONFIG_DIR:
            folder = value if equals else next(rest, None)
            if not folder:
                raise UserError(f"{CONFIG_DIR} takes a folder: {CONFIG_DIR} DIR")
            folders.append(Path(folder).expanduser())
        else:
            overrides.append(word)
    return config.load(overrides, folders)


def _run(words: list[str]) -> int:
    from bench.report.finish import finish
    from bench.run.progress import empty_shard

    finished = _execute(_load(words), words)
    if isinstance(finished, int):
        return finished
    if finished.experiment.execution.shard is None:
        return _show(finished.experiment, *finish(finished, words))
    if not finished.planned:
        print(empty_shard(finished.experiment))
        return 0
    print(
        f"{len(finished.planned)} cells of this shard are stored in '{printable(finished.experiment.directory)}'; "
        "when all shards have run, write tables and charts with `report` and the same words, without shard="
    )
    return _status(finished.rows())


def _execute(experiment: Experiment, words: Sequence[str]) -> Finished | int:
    """Run an experiment. Returns the finished run, or the exit status if it ended early."""
    from bench.experiment.grid import cells
    from bench.run.execute import Stopped, execute, store_of

    try:
        return execute(experiment, QUIET in words)
    except (KeyboardInterrupt, Stopped) as end:
        store = store_of(experiment)
        keys = {cell.key for cell in cells(experiment)}
        stored = int(store.load()["key"].isin(keys).sum())
        is_interrupt = isinstance(end, KeyboardInterrupt)
        why = "stopped" if is_interrupt else f"stopped {printable(end)}"
        again = shlex.join(["python", "-m", "bench", *words])
        print(
            f"\nbench: {why}; {stored} of {len(keys)} cells are stored in '{store.directory}'. Continue with: {again}",
            file=sys.stderr,
        )
        return 130 if is_interrupt else 1


def _show(experiment: Experiment, rows: pd.DataFrame, views: Views, paths: Sequence[Path]) -> int:
    from bench.report import writer

    writer.show(experiment, rows, views)
    _print_written(paths)
    return _status(rows)


def _status(rows: pd.DataFrame) -> int:
    return int((rows["status"] == "error").any())


def _print_written(paths: Sequence[Path]) -> None:
    """Print where the files of a command are: each of a few files, or the folders of many, and the page."""
    # three files or fewer are listed one by one
    if len(paths) <= 3:
        print("\nWritten:", *map(printable, paths), sep="\n  ")
        return
    counts = Counter(path.parent for path in paths)
    print("\nWritten: " + ", ".join(f"{count} files in {printable(folder)}" for folder, count in counts.items()))
    for path in paths:
        if path.name == "report.html":
            print(f"Page: {printable(path)}")


def _report(words: list[str]) -> int:
    from bench.report.finish import report

    experiment = _load(words)
    return _show(experiment, *report(experiment))


def _plan(words: list[str]) -> int:
    from dataclasses import replace

    from bench.experiment import config
    from bench.run import plan, progress
    from bench.run.execute import missing_references, store_of

    experiment = _load(words)
    store = store_of(experiment)
    rows = store.load()
    if rows.empty:  # times of the standard results, on another machine, are better than none
        rows = store_of(replace(experiment, results_dir=config.config_dir().parent / "results" / "standard")).load()
    planned = plan.plan(experiment, store)
    n_references = len(missing_references(experiment, [item.cell for item in planned if item.runs]))
    progress.print_plan(experiment, planned, rows, n_references)
    return 0


# ----------------------------------------------------------------------------------------------------- list


def _list(words: list[str]) -> int:
    """List the plugins of the given kinds or names with their parameters; without any, the names of all by kind."""
    from textwrap import fill

    from bench.api import described, matching_plugins
    from bench.experiment.words import parse_words
    from bench.host.identity import text_of
    from bench.host.parameters import parameters

    names, _, _ = parse_words(words, "list", {})
    for kind, listed in matching_plugins(names).items():
        if not names:
            given = ", ".join(
                name if entry.available else f"{name} (unavailable)" for name, entry in sorted(listed.items())
            )
            print(
                fill(
                    printable(f"{kind}: {given}"),
                    100,
                    subsequent_indent="  ",
                    break_long_words=False,
                    break_on_hyphens=False,
                )
            )
            continue
        if listed:
            print(f"\n{printable(kind)}")
        for name, entry in sorted(listed.items()):
            print(f"  {printable(name):<22}{printable(described(entry))}")
            for parameter in parameters(entry.plugin).values() if entry.plugin else ():
                unit = f" [{parameter.unit}]" if parameter.unit else ""
                choices = f" ({' | '.join(parameter.choices)})" if parameter.choices else ""
                line = f"{parameter.name}={text_of(parameter.default)}{unit}  {parameter.doc}{choices}"
                print(f"      {printable(line)}")
    return 0


# ---------------------------------------------------------------------------------------- checks and traces


def _refer(verb: str, names: Sequence[str]) -> None:
    """Raise :class:`UserError` with the right command if a name is the subject of another command of :data:`FAMILY`."""
    from bench.model import registry

    for name in names:
        plugin = name.partition("[")[0]
        if re.search(r"\.py(:|$)", name):
            subject, right = "a simulator of your own", "examine"
        elif ":" in name:
            continue
        elif plugin in registry.entries()["scenes"]:
            subject, right = "a scene", "gradcheck"
        elif any(plugin in entries for entries in registry.entries().values()):
            subject, right = "a plugin", "check"
        else:
            continue
        if right != verb and (verb, right) != ("check", "gradcheck"):  # a scene is a plugin too
            raise UserError(f"'{name}' is {subject}, which {verb} does not take: python -m bench {right} {name}")


def _check(words: list[str]) -> int:
    """Verify the declarations of the named plugins, or of all; from the first option on, words are pytest's."""
    from bench.conformance import main
    from bench.experiment.words import parse_words

    own = list(itertools.takewhile(lambda word: not word.startswith("-"), words))
    names, settings, _ = parse_words(own, "check", {"limit": "15m"})
    _refer("check", names)
    return main(names, settings["limit"], words[len(own) :])


def _examine(words: list[str]) -> int:
    """Examine a user's simulator."""
    from bench.examine import command

    _refer("examine", [word for word in words if "=" not in word.partition("[")[0] and not word.startswith("-")])
    return command.main(words)


def _split_scenes(words: Sequence[str], verb: str) -> tuple[list[str], list[str]]:
    """Return the scenes named first, as a word ``scenes=[...]``, and the settings after them.

    Raises :class:`UserError` if no scene is named.
    """
    scenes = list(itertools.takewhile(lambda word: "=" not in word.partition("[")[0] and word[0] != "-", words))
    settings = list(words[len(scenes) :])
    if not scenes and not _is_given("scenes", settings):
        raise UserError(
            f"name a scene: python -m bench {verb} SCENE ... [key=value ...]; all: python -m bench list scenes"
        )
    return ([f"scenes=[{','.join(scenes)}]"] if scenes else []), settings


def _gradcheck(words: list[str]) -> int:
    """Run ``gradient_check`` on the scenes named first. Returns 1 if a cell has an error or a gradient is wrong."""
    from dataclasses import replace

    from bench.host.parameters import parameters
    from bench.report.finish import finish

    scenes, settings = _split_scenes(words, "gradcheck")
    _refer("gradcheck", words[: len(words) - len(settings)])
    experiment = _with_engine(["experiment=gradient_check", *scenes, "name=gradcheck"], settings)
    plugins = [choice.entry.plugin for choice in experiment.choices["scene"]]
    own = {
        int(parameters(plugin)["horizon"].default) for plugin in plugins if plugin and "horizon" in parameters(plugin)
    }
    if not _is_given("sweep.horizon", settings):
        sweep = dict(experiment.sweep)
        choices = [dict(choice.values) for choice in experiment.choices["scene"]]
        is_set = any("horizon" in values for values in (*choices, *experiment.values.get("scene", {}).values()))
        if own and not is_set:
            sweep["horizon"] = sorted({*sweep["horizon"], *own})
        else:
            sweep.pop("horizon", None)
        experiment = replace(experiment, sweep=sweep)
    finished = _execute(experiment, words)
    if isinstance(finished, int):
        return finished
    rows, views, paths = finish(finished, ["gradcheck", *words])
    return int(_show(experiment, rows, views, paths) or experiment.study.faults(rows) > 0)


def _with_engine(words: list[str], settings: list[str]) -> Experiment:
    """Return the experiment of words and settings, with a backend and law for scenes that only engines run."""
    from bench.model import EngineScene

    experiment = _load([*words, *settings])
    plugins = [choice.entry.plugin for choice in experiment.choices["scene"]]
    words_of_engines = ("backends=[mujoco]", "contacts=[penalty]")
    in_engines = [word for word in words_of_engines if not _is_given(word.partition("=")[0], settings)]
    if in_engines and all(plugin and issubclass(plugin, EngineScene) for plugin in plugins):
        print(f"bench: only engines run these scenes: {' '.join(in_engines)}", file=sys.stderr)
        return _load([*words, *in_engines, *settings])
    return experiment


def _is_given(key: str, settings: Sequence[str]) -> bool:
    return any(word.lstrip("+").startswith(f"{key}=") for word in settings)


def _trace(words: list[str]) -> int:
    """Trace one rollout of each scene named first: at w = 0, or for a noise sample if ``seed=`` is given."""
    from bench import trace

    scenes, settings = _split_scenes(words, "trace")
    experiment = _with_engine(scenes, settings)
    for rollout in trace.run(experiment, _is_given("seed", settings)):
        paths = trace.write(rollout, experiment.results_dir, experiment.formats)
        print(f"\n{printable(rollout.title)}")
        for sentence in rollout.report():
            print(f"  {printable(sentence)}")
        _print_written(paths)
    return 0


def _main_of(module: str) -> Callable[[list[str]], int]:
    """Return a function that imports a module when it is called, and calls the module's ``main``."""

    def call(words: list[str]) -> int:
        status: int = importlib.import_module(module).main(words)
        return status

    return call


VERBS = {
    "run": Verb(
        _run,
        "+experiment=NAME [key=value ...]",
        "run what is missing, then write tables and charts",
        f"Without an experiment, name=FOLDER and the settings say what is run.\n{SETTINGS}{STATUS}",
        "Experiments",
    ),
    "report": Verb(
        _report,
        "report +experiment=NAME [key=value ...]",
        "tables and charts again from stored rows",
        "Nothing is simulated.\n" + SETTINGS,
        "Experiments",
    ),
    "plan": Verb(
        _plan,
        "plan +experiment=NAME [key=value ...]",
        "cells, how many are stored, expected time",
        "Cells that cannot run are listed with their reason.\n" + SETTINGS,
        "Experiments",
    ),
    "list": Verb(
        _list,
        "list [KIND or NAME ...] [plugins=DIR]",
        "plugins by kind; for a KIND or NAME also parameters and availability",
        "KIND is scenes, contacts, integrators, backends, estimators, optimizers, policies, trainers or studies.\n",
        "Experiments",
    ),
    "engines": Verb(
        _main_of("bench.engines.command"),
        "engines [install NAME ... | table [NAME ...] | set OUT | metamorphic MODEL]",
        "physics engines in a Python of their own, and tests for any engine",
        "Without arguments it lists each engine's environment, or how to make it. The environments are in $BENCH_ENGINES,\n"
        "otherwise in the user's cache. plugins=DIR: engines of your own. NAME==VERSION: another release.\n  install      makes environments from the engines' requirements; --again makes them from the start\n"
        "  table        writes a page and a CSV of the conformance set and engine_gradients (key=value: its settings), out=DIR\n"
        "  set          copies the conformance set into OUT\n  metamorphic  checks mujoco, or NAME, on MODEL without a reference: steps=60 seed=0\n",
        "Experiments",
    ),
    "check": Verb(
        _check,
        "check [NAME ...] [limit=15m] [plugins=DIR] [option of pytest ...]",
        "plugins: does each do what it declares?",
        "Runs the conformance kit on the named plugins, or on all, in pytest: -k WORD selects checks, -x stops at the first\n"
        "failure, --junitxml=FILE writes a report. A check that takes longer than `limit` or ends its process fails.\n"
        "Exit status 1 when a check fails.\n\n" + FAMILY,
        "Is it right?",
    ),
    "gradcheck": Verb(
        _gradcheck,
        "gradcheck SCENE ... [key=value ...]",
        "scenes: is each gradient the derivative of its program?",
        "Compares gradients with differences of the cost, also at a contact switch.\n"
        f"Exit status 1 when a gradient must not be used.\n\n{FAMILY}\n{SETTINGS}",
        "Is it right?",
    ),
    "examine": Verb(
        _examine,
        "examine FILE:COST [key=value ...]",
        "your own simulator: its gradient, jumps, and what to use",
        f"{EXAMINE}\n{FAMILY}",
        "Is it right?",
    ),
    "trace": Verb(
        _trace,
        "trace SCENE ... [key=value ...]",
        "one rollout: do gradient spikes coincide with contact switches?",
        f"Without noise, or with seed=S the first sample of that seed.\n{SETTINGS}",
        "Is it right?",
    ),
    "claims": Verb(
        _main_of("bench.claims"),
        "claims [NAME ...] [--list] [--quick] [--again] [results_dir=DIR]",
        "published results run again, each with a verdict",
        "Results stored under results_dir/claims are measured again only if their code has changed, or with --again.\n"
        "--quick: only claims that take less than 5 s. plugins=DIR: claims of your own.\n"
        "Exit status 1 when a claim is not reproduced.\n",
    ),
    "compare": Verb(
        _main_of("bench.compare.command"),
        "compare BEFORE AFTER [again=DIR,DIR] [out=DIR]",
        "two results, cell by cell; status 1 if a cell got worse",
        "BEFORE and AFTER are directories, or git revisions as REV or REV:PATH. Errors decide, paired on equal noise. Times\n"
        "decide only with again=DIR,DIR: further runs of BEFORE, whose spread they are compared with.\n"
        "Written to out=DIR (runs/compare): compare.csv and .md.\n",
    ),
    "index": Verb(
        _main_of("bench.report.index"),
        "index [DIR]",
        "a page over all experiments of a results folder, with the state of each",
        "DIR is results by default. Written to DIR/index.html. Nothing is simulated.\n",
    ),
    "history": Verb(
        _main_of("bench.compare.history"),
        "history DIR DIR ... [out=DIR]",
        "the error of each estimator over versions, as a chart and a table",
        "Directories or git revisions, the oldest first. Written to out=DIR (runs/history): history.png, .csv and .md.\n",
    ),
}
