"""Runs random valid and spoilt configurations: ``python validation/configurations.py COUNT [SEED]``.

Studies, plugins, parameters within their bounds, sweeps and settings are drawn from the declarations in the registry. Then
one word of every fourth configuration is spoilt. Each configuration is run in this process, with few samples, into a folder
that contains results of earlier ones. After the run, every planned cell must have a row, every row ever stored must still be
there with the same bits, and a second plan must have nothing to run. Some runs are interrupted first, some are repeated
with the cells in another order in an empty folder, where rows must have the same bits, and some write tables, charts and
page. A refused configuration must have a reason of one line and change nothing. Prints the faults and one line of counts;
the exit status is 1 for any fault.
"""

from __future__ import annotations

import contextlib
import io
import os
import random
import shutil
import sys
import tempfile
import time
import traceback
import types
import typing
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from exact import by_key, differences

from bench.cli import main
from bench.errors import UserError
from bench.experiment import config
from bench.experiment.views import Views
from bench.model import registry
from bench.model.parameters import Parameter, parameters
from bench.report import finish
from bench.run import plan, runner
from bench.run.execute import store_of
from bench.run.store import Store

SEASON = 25
"""Configurations that share a folder."""
TINY = ["samples=2", "repeats=2", "timing=false", "workers=0", "--quiet", "reference.samples=256", "reference.tolerance=9"]  # fmt: skip
SPOILT, INTERRUPTED, AGAIN, WRITTEN = 0.25, 0.1, 0.2, 0.005
"""Shares of the configurations that are spoilt, interrupted, repeated in another folder, and run with charts and page."""
ODD = ["nan", "-1", "[]", "[[1]]", "{a:1}", "null", "1e400", "'x'", "${x}", "0x1", "~", "a[b=", "[1,1]", "true", "\u00fc", "3.5"]  # fmt: skip
LONGEST = 4
"""Steps of the longest rollout."""


# ------------------------------------------------------------------------------------------------------------- drawing


def value(dice: random.Random, parameter: Parameter) -> str | None:
    """Return a random value within a parameter's bounds as a string, or None for a type without a rule."""
    union = typing.get_args(parameter.type) if isinstance(parameter.type, types.UnionType) else (parameter.type,)
    if type(None) in union and dice.random() < 0.2:
        return "null"
    kind = next(one for one in union if one is not type(None))
    if parameter.choices:
        return dice.choice(parameter.choices)
    if kind is bool:
        return dice.choice(["true", "false"])
    if kind is int:
        low = int(parameter.low if parameter.low is not None else 1)
        most = LONGEST if parameter.name == "horizon" else low + 4
        return str(dice.randint(low, int(min(most, parameter.high if parameter.high is not None else most))))
    if kind is not float:
        return None
    usual = parameter.default if isinstance(parameter.default, float) and abs(parameter.default) < 1e12 else 1.0
    drawn = usual * 10 ** dice.uniform(-0.5, 0.5) if usual else dice.uniform(0.0, 1.0)
    low, high = (bound if bound is not None else drawn for bound in (parameter.low, parameter.high))
    return dice.choice([repr, "{:.3g}".format])(min(max(drawn, low), high))


def settable(kind: str, name: str) -> dict[str, Parameter]:
    """Return the parameters of a plugin for which :func:`value` returns a value, by name."""
    plugin = registry.find(kind, name).plugin
    known = parameters(plugin) if plugin is not None else {}
    return {one: known[one] for one in known if value(random.Random(0), known[one]) is not None}


@cache
def usually() -> dict[str, Any]:
    """Return the default settings of a run, from ``config.yaml``."""
    return dict(yaml.safe_load((config.config_dir() / "config.yaml").read_text()))


def few(dice: random.Random, among: list[str]) -> list[str]:
    """Return one random item of ``among``, or two with probability 0.3."""
    return dice.sample(among, min(len(among), 1 if dice.random() < 0.7 else 2))


def identity(dice: random.Random, kind: str, name: str) -> str:
    """Return a plugin's identity string: its name, in 40% of the draws with one or two parameters in brackets."""
    known = settable(kind, name)
    if not known or dice.random() < 0.6:
        return name
    chosen = dice.sample(sorted(known), dice.randint(1, min(2, len(known))))
    return f"{name}[{','.join(f'{one}={value(dice, known[one])}' for one in chosen)}]"


def axis(dice: random.Random, kind: str, name: str, count: int) -> tuple[str, list[str]] | None:
    """Return a random parameter to sweep, by its own or its full name, and ``count`` values; None without parameters."""
    known = {one: p for one, p in settable(kind, name).items() if p.choices is None}
    if not known:
        return None
    chosen = dice.choice(sorted(known))
    drawn = [str(value(dice, known[chosen])) for _ in range(count)]
    return dice.choice([chosen, f"{name}.{chosen}"]), drawn


def sweep(dice: random.Random, chosen: dict[str, list[str]]) -> list[str]:
    """Return the command-line words of a random sweep with few points."""
    kinds = [kind for kind in chosen if kind != "backends"]
    count = dice.randint(1, 3)
    found = [axis(dice, kind, dice.choice(chosen[kind]), count) for kind in dice.sample(kinds, min(2, len(kinds)))]
    axes = dict([one for one in found if one is not None])
    if dice.random() < 0.4:
        axes["seed"] = [str(dice.randrange(1000)) for _ in range(count)]
    if dice.random() < 0.1:
        axes["samples"] = [str(dice.randint(2, 4)) for _ in range(count)]
    lists = [f"{name}:[{','.join(values)}]" for name, values in axes.items()]
    shape = dice.choice(["product", "product", "zip", "union", "table"])
    if not lists or shape == "product":
        return [f"sweep.{one.replace(':', '=')}" for one in lists[:2]]
    if shape == "union":
        return ["sweep.union=[" + ",".join("{" + one + "}" for one in lists) + "]"]
    inner = "{" + ",".join(lists[:2]) + "}"
    return [f"sweep={inner}" if shape == "table" else f"sweep.zip={inner}"]


def drawn(dice: random.Random) -> list[str]:
    """Return the words of a random configuration; the last word is the folder's ``name=``."""
    studies = sorted(name for name, one in registry.entries()["studies"].items() if one.available)
    study = "bias_variance" if dice.random() < 0.6 else dice.choice(studies)
    plugin = registry.find("studies", study).plugin
    assert plugin is not None
    counts = [f"{one}={value(dice, p)}" for one, p in settable("studies", study).items() if p.type in (int, int | None)]
    words: list[str] = [*TINY, f"study={study}[{','.join(counts)}]" if counts else f"study={study}"]
    chosen: dict[str, list[str]] = {}
    for one in plugin.axes:
        kind = registry.kind_of(one)
        entries = registry.entries()[kind]
        names = ["numpy"] if kind == "backends" else sorted(name for name in entries if entries[name].available)
        usual = usually()[kind] if kind in ("contacts", "integrators") and dice.random() < 0.7 else None
        chosen[kind] = usual or few(dice, names)
        words.append(f"{kind}=[{','.join(identity(dice, kind, name) for name in chosen[kind])}]")
        for name in chosen[kind]:
            known = settable(kind, name)
            if "horizon" in known:
                words.append(f"{one}.{name}.horizon={dice.randint(1, LONGEST)}")
            elif known and dice.random() < 0.2:
                moved = dice.choice(sorted(known))
                words.append(f"{one}.{name}.{moved}={value(dice, known[moved])}")
    if dice.random() < 0.6:
        words += sweep(dice, chosen)
    if dice.random() < 0.15:
        floats = [one for one, p in settable("scenes", chosen["scenes"][0]).items() if p.type is float]
        words.append(f"theta=[{','.join(dice.sample(floats, min(len(floats), dice.randint(1, 2))))}]")
    for word, share in {
        f"seed={dice.randrange(10**6)}": 0.3, f"repeats={dice.randint(2, 4)}": 0.2, f"samples={dice.randint(3, 12)}": 0.5,
        "retry=[error]": 0.1, "versions=ignore": 0.1, "on_error=stop": 0.05, "compile_time=true": 0.05,
        "question='why | not, \u00fc?'": 0.1, "marks={sigma:{here:0.1}}": 0.05, "formats=[svg]": 0.1,
        "table.rows=[estimator,backend]": 0.1, "timeout=1m": 0.1, "memory=null": 0.1,
    }.items():  # fmt: skip
        if dice.random() < share:
            words.append(word)
    return [*words, f"name={study}_{dice.randrange(2)}"]


def spoil(dice: random.Random, words: list[str]) -> list[str]:
    """Return the words with one random word spoilt, other than :data:`TINY` and the folder's name."""
    place = dice.randrange(len(TINY), len(words) - 1)
    key, _, given = words[place].partition("=")
    how = dice.randrange(4)
    if how == 0:
        word = f"{key}={dice.choice(ODD)}"
    elif how == 1 and given:
        cut = dice.randrange(len(given))
        word = f"{key}={given[:cut]}{dice.choice('[]{}=,:.x0 ')}{given[cut + 1 :]}"
    elif how == 2:
        cut = dice.randrange(len(key))
        word = f"{key[:cut]}{dice.choice('abx._')}{key[cut + 1 :]}={given}"
    else:
        word = f"{key}.{dice.choice(['x', 'sigma', '0', ''])}={given}"
    return [*words[:place], word, *words[place + 1 :]]


def turn(given: str) -> str:
    """Return a bracketed list of identity strings in reverse order; any other string unchanged."""
    return f"[{','.join(reversed(items(given)))}]" if given.startswith("[") else given


def items(given: str) -> list[str]:
    """Return the items of a bracketed list, which may have brackets themselves."""
    parts, depth = [""], 0
    for letter in given[1:-1]:
        depth += (letter == "[") - (letter == "]")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


# ------------------------------------------------------------------------------------------------------------- running


class Interrupted:
    """Context manager that interrupts a run in this process after ``after`` calls that store rows."""

    def __init__(self, after: int) -> None:
        self._left, self._real = after, runner._Run._finish

    def __enter__(self) -> None:
        def finish(run: Any, results: Any, stored: bool = False) -> None:
            self._real(run, results, stored)
            self._left -= 1
            if self._left == 0:
                raise KeyboardInterrupt

        runner._Run._finish = finish  # type: ignore[method-assign]

    def __exit__(self, *_: object) -> None:
        runner._Run._finish = self._real  # type: ignore[method-assign]


REMARKS = (", while it was imported, changed",)
"""What only remarks on settings contain; a refused command may print some before its error."""


def is_refusal(said: str) -> bool:
    """Return whether the stderr of a refused command is one line with the error, after any remarks on its settings."""
    *remarks, error = said.splitlines() or [""]
    return (
        all(line.startswith("bench: ") for line in (*remarks, error))
        and all(any(part in line for part in REMARKS) for line in remarks)
        and "\x1b" not in said
    )


class Ledger:
    """Runs configurations, and records their rows and faults."""

    def __init__(self, place: Path, seed: int) -> None:
        self.place, self.dice = place, random.Random(seed)
        self.statuses: Counter[Any] = Counter()
        self.rows: Counter[str] = Counter()
        self.done: Counter[str] = Counter()
        self.faults: Counter[str] = Counter()
        self.held: dict[str, dict[str, dict[str, Any]]] = {}
        self.loaded: list[Any] = []
        self.folder = place / "0"

    def fault(self, kind: str, words: list[str], more: object = "") -> None:
        """Count a fault, and print it."""
        self.faults[kind] += 1
        print(f"{kind}: {words[len(TINY) :]!r}: {str(more)[:1500]}", flush=True)

    def command(self, words: list[str], folder: Path, charts: bool = False) -> tuple[Any, str]:
        """Run words into a folder; returns the exit status (None after an exception) and stderr with any traceback."""
        write, load, out, err = finish.write, config.load, io.StringIO(), io.StringIO()

        def loaded(*given: Any) -> Any:
            self.loaded[:] = [load(*given)]
            return self.loaded[0]

        config.load = loaded
        if not charts:
            finish.write = lambda *_: (Views(), [])
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                return main(["run", *words, f"results_dir={folder}"]), err.getvalue().strip()
        except BaseException:
            return None, f"{err.getvalue()} {traceback.format_exc()}"
        finally:
            finish.write, config.load = write, load

    def stored(self, name: str, folder: Path) -> dict[str, dict[str, Any]]:
        """Return the rows stored under ``name`` in a folder, by key, as :func:`exact.bits`, without times of untimed cells."""
        columns = registry.usable("studies", name.rpartition("_")[0]).columns
        untimed = [column.name for column in columns.all if column.untimed]
        return by_key(Store(folder / name, columns).load().drop(columns=untimed))

    def check(self, words: list[str], charts: bool = False) -> None:
        """Run a configuration, and count lost or changed rows and other faults."""
        if self.dice.random() < INTERRUPTED:
            with Interrupted(self.dice.randint(1, 3)):
                self.command(words, self.folder)
            self.done["interrupted"] += 1
        status, said = self.command(words, self.folder, charts)
        self.statuses[status] += 1
        if status not in (0, 1, 2) or "Traceback" in said:
            return self.fault("traceback", words, said[-1500:])
        if status == 2 and not is_refusal(said):
            self.fault("message", words, said)
        self.look(words, words[-1].removeprefix("name="))
        if status != 2:
            self.whole(words, status, charts)

    def look(self, words: list[str], name: str) -> None:
        """Count a fault if rows that a folder had before are lost or changed."""
        if not (self.folder / name).is_dir():
            if name in self.held:
                self.fault("lost", words, f"all rows of {name}")
            return
        now, rows = self.stored(name, self.folder), self.held.get(name, {})
        if lost := rows.keys() - now.keys():
            self.fault("lost", words, f"{len(lost)} rows of {name}")
        elif changed := differences(rows, now):
            self.fault("changed", words, changed[:3])
        self.held[name] = now

    def whole(self, words: list[str], status: int, charts: bool) -> None:
        """Verify a run that ended by itself: a row per planned cell, a reason per failure, and nothing left to run."""
        experiment, name = self.loaded[0], words[-1].removeprefix("name=")
        with contextlib.redirect_stderr(io.StringIO()):
            planned = plan.plan(experiment, store_of(experiment))
        mine, stopped = self.held.get(name, {}), experiment.execution.stop and status == 1
        missing = [item.cell.key for item in planned if item.cell.key not in mine]
        if missing and not stopped:
            self.fault("lost", words, f"{len(missing)} cells of {len(planned)} have no row")
        if any(item.runs for item in planned) and not stopped and not experiment.execution.retry:
            self.fault("not stored", words)
        rows = {item.cell.key: mine[item.cell.key] for item in planned if item.cell.key in mine}
        self.rows.update(row["status"] for row in rows.values())
        for row in rows.values():
            if (row["status"] != "ok" and not row["reason"]) or "Traceback" in row["reason"]:
                self.fault("reason", words, row)
        if charts:
            self.done["written"] += 1
            if not stopped and not (experiment.directory / "report.html").exists():
                self.fault("no page", words)
        if self.dice.random() < AGAIN and not stopped:
            self.again(words, name, rows)

    def again(self, words: list[str], name: str, rows: dict[str, dict[str, Any]]) -> None:
        """Run the same cells in another order in an empty folder, and count a fault if their rows differ."""
        self.done["run again elsewhere"] += 1
        split = [word.partition("=") for word in words]
        turned = [f"{key}{equals}{turn(given) if key in registry.kinds() else given}" for key, equals, given in split]
        elsewhere = self.place / "elsewhere"
        status, said = self.command(turned, elsewhere)
        if status not in (0, 1):
            self.fault("traceback" if status is None else "refused elsewhere", words, said[-1500:])
        else:
            other = self.stored(name, elsewhere)
            changed = differences(other, rows) if other.keys() == rows.keys() else ["other keys"]
            if changed:
                self.fault("changed", words, f"elsewhere: {changed[:3]}")
        shutil.rmtree(elsewhere, ignore_errors=True)

    def next_folder(self) -> None:
        """Verify that the folder has all its rows and no temporary file, then start an empty folder."""
        for name in list(self.held):
            self.look([], name)
        for path in self.folder.rglob(".*") if self.folder.exists() else ():
            self.fault("temporary", [], path)
        shutil.rmtree(self.folder, ignore_errors=True)
        self.held, self.folder = {}, self.place / str(int(self.folder.name) + 1)


def search(count: int, seed: int) -> Ledger:
    """Draw and run ``count`` configurations, and return their rows and faults."""
    backend = registry.find("backends", "numpy").plugin
    assert backend is not None
    before = backend.reference_rank  # type: ignore[attr-defined]
    backend.reference_rank = -1  # type: ignore[attr-defined]  # compiling for each structure would take most of the time
    try:
        with tempfile.TemporaryDirectory() as place:
            ledger = Ledger(Path(place), seed)
            for number in range(count):
                words = drawn(ledger.dice)
                if ledger.dice.random() < SPOILT:
                    words = spoil(ledger.dice, words)
                    ledger.done["spoilt"] += 1
                try:
                    ledger.check(words, charts=ledger.dice.random() < WRITTEN)
                except (UserError, ValueError, OSError):
                    ledger.fault("unreadable", words, traceback.format_exc())
                if number % SEASON == SEASON - 1:
                    ledger.next_folder()
            return ledger
    finally:
        backend.reference_rank = before  # type: ignore[attr-defined]


def show(count: int, seed: int) -> int:
    """Run ``count`` configurations, print the counts, and return the exit status."""
    started = time.process_time()
    ledger = search(count, seed)
    valid = sum(number for status, number in ledger.statuses.items() if status in (0, 1))
    print(
        f"{count} configurations of seed {seed}: {valid} valid, statuses {dict(ledger.statuses)}, {dict(ledger.done)}; "
        f"rows {dict(ledger.rows)}; faults {dict(ledger.faults) or 'none'}; {time.process_time() - started:.0f} s"
    )
    return 1 if ledger.faults else 0


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(show(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0))
