"""Runs misbehaving plugins, every fault at every place: ``python validation/misbehave.py COUNT [SEED]``.

Each plugin is a file in one folder. Cases are drawn so that faults and places are equally frequent. Each plugin must be
listed or have its own row, with a status and a reason of one line if it did harm. Cells of sound plugins must have the same
numbers as without the misbehaving plugins. Tracebacks, escape characters and remaining processes are findings. Prints a line
per finding and one of counts; the exit status is 1 for any finding.
"""

from __future__ import annotations

import os
import random
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
import psutil

from bench.run.store import Store
from bench.studies.bias_variance.columns import COLUMNS

HEAD = '"""Misbehaves."""\nimport ctypes, os, re, signal, subprocess, sys, threading, time, warnings\nfrom dataclasses import dataclass\nimport numpy as np\n'
ENDS = {
    "crashes": "ctypes.string_at(0)",
    "aborts": "os.abort()",
    "is_killed": "os.kill(os.getpid(), signal.SIGKILL)",
    "leaves_at_once": "os._exit(0)",
    "hangs": "while True: time.sleep(1)",
    "hangs_in_c": "re.match('(a*)*b', 'a' * 64)",
    "allocates": "kept = [b'x' * (1 << 26) for _ in range(1 << 10)]",
    "closes_descriptors": "os.closerange(0, 256); ctypes.string_at(0)",
    "stops": "os.kill(os.getpid(), signal.SIGSTOP)",
}
"""Faults that end or block the process, and cannot be caught inside it."""
RAISES = {
    "exits": "sys.exit(0)",
    "raises": "raise ValueError('no\\x1b[31m | estimate\\ntoday')",
    "raises_base": "raise BaseException('of no kind')",
    "raises_generator_exit": "raise GeneratorExit",
    "raises_a_novel": "raise ValueError('\\0novel ' * 1000000)",
    "recurses": "recursive = lambda: recursive(); recursive()",
    "raises_the_unprintable": "raise type('Silent', (Exception,), {'__str__': lambda self: 1 / 0})()",
    "imports_what_is_not": "import nothing_of_that_name",
    "has_bad_syntax": "exec('a b')",
    "runs_out": "raise MemoryError",
}
HARMLESS = {
    "forks": "os.fork()",
    "leaves_a_process": "subprocess.Popen(['sleep', '613'])",
    "leaves_a_session": "subprocess.Popen(['sleep', '614'], start_new_session=True)",
    "leaves_a_thread": "threading.Thread(target=time.sleep, args=(615,)).start()",
    "shouts": "print('\\x1b[31mshout' * 100000, flush=True); os.write(2, b'y' * 1000000)",
    "seeds": "np.random.seed(0); np.seterr(all='raise')",
    "changes_folder": "os.chdir('/')",
    "warns": "warnings.warn('loudly')",
    "catches_signals": "signal.signal(signal.SIGTERM, signal.SIG_IGN) if threading.current_thread() is threading.main_thread() else None",
}
"""Side effects that leave the numbers right: the plugin's rows may be ``ok``."""
LIES = {
    "lies_in_shape": "np.vstack([value, value])",
    "lies_in_length": "value[..., :-1]",
    "lies_in_rank": "value[None]",
    "gives_none": "None",
    "gives_text": "'seven'",
    "gives_objects": "np.array(value, dtype=object)",
    "gives_complex": "value + 1j",
    "gives_nothing": "value[:0]",
    "gives_nan": "value * np.nan",
    "gives_infinity": "value + np.inf",
    "gives_a_generator": "(one for one in value)",
}
"""Results of a wrong shape, type or value; rows may be ``ok``, since some may be intended (an array of objects)."""
DECLARES = {
    "no_name": "name = None",
    "odd_name": "name = 'a b[c]'",
    "taken_name": "name = {taken!r}",
    "no_requires": "requires = None",
    "odd_requires": "requires = (7,)",
    "odd_kind": "kind = 'a kind'",
    "odd_annotation": "much: 'list[int' = 3",
    "list_parameter": "much: list = ()",
    "missing_library": "requires = ('a_library_of_no_one',)",
}
"""Invalid declarations: each plugin must be listed as unavailable, with the reason."""
KINDS = {
    "estimators": ("fobg", "Fobg", "scenes=[quadratic] backends=[numpy]", "estimators=[fobg{}]", ("terms", "estimate"), ("unsupported_reason",)),
    "scenes": ("quadratic", "Quadratic", "estimators=[fobg,reinforce] backends=[numpy]", "scenes=[quadratic{}]", ("cost",), ("theta0", "closed_form_gradient", "breakpoints")),
    "backends": ("numpy", "Numpy", "scenes=[quadratic] estimators=[fobg]", "backends=[numpy{}]", ("compile",), ("unsupported_reason",)),
    "contacts": ("penalty", "Penalty", "scenes=[bounce_once] backends=[numpy] estimators=[fobg] integrators=[semi_implicit_euler]", "contacts=[penalty{}]", ("force",), ("spring",)),
    "integrators": ("semi_implicit_euler", "SemiImplicitEuler", "scenes=[mass_spring] backends=[numpy] estimators=[fobg]", "integrators=[semi_implicit_euler{}]", ("step",), ("transition",)),
}  # fmt: skip
"""By kind: module and class of a sound plugin, other axes, own axis, methods called by workers, methods called by plan."""
# limits are ten times what sound plugins take on an idle machine, so that a busy plugin does not count as hanging
WORDS = ["samples=8", "repeats=3", "timing=false", "workers=2", "timeout=45s", "memory=700m", "reference.samples=4096", "formats=[png]", "--quiet"]  # fmt: skip
START = "import runpy; from bench.model import trial; trial.TIMEOUT_S = 30.0; runpy.run_module('bench', run_name='__main__')"
SAID = re.compile(r"Traceback|[\x00-\x08\x0b-\x1f]")


@dataclass(frozen=True)
class Case:
    """One misbehaving plugin: its kind, and the fault at one place of its file or class."""

    kind: str
    place: str
    fault: str

    @property
    def name(self) -> str:
        """The name of the plugin and of its file."""
        return f"{self.kind[:4]}_{self.place}_{self.fault}"

    @property
    def harmful(self) -> bool:
        """Whether none of its rows may be ``ok``."""
        return self.fault not in HARMLESS | LIES

    def text(self) -> str:
        """Return the source of the plugin's file."""
        module, base, *_ = KINDS[self.kind]
        lines = [HEAD, f"from bench.plugins.{self.kind}.{module} import {base}"]
        act = (ENDS | RAISES | HARMLESS).get(self.fault, "pass")
        lines += ["def fault():", f"    {act}", "def lie(value):", f"    return {LIES.get(self.fault, 'value')}"]
        lines += ["fault()"] if self.place == "import" else []
        lines += [
            "@dataclass(frozen=True)",
            f"class Bad({base}):",
            '    """Misbehaves."""',
            f"    name = {self.name!r}",
        ]
        if self.place == "declared":
            lines.append(f"    {DECLARES[self.fault].format(taken=module)}")
        elif self.place != "import":
            call = "__post_init__" if self.place == "construction" else self.place
            back = "" if call == "__post_init__" else f"        return lie(super().{call}(*given))"
            lines += [f"    def {call}(self, *given):", "        fault()", back]
        return "\n".join(lines) + "\n"


def bank() -> list[Case]:
    """Return every possible case."""
    cases = []
    for kind, (*_, work, planned) in KINDS.items():
        loud = ENDS | RAISES | HARMLESS
        cases += [Case(kind, "declared", fault) for fault in DECLARES]
        cases += [Case(kind, place, fault) for place in ("import", *work) for fault in loud]
        # a plugin is built and planned by the command itself, which it may end
        cases += [Case(kind, place, fault) for place in ("construction", *planned) for fault in RAISES | HARMLESS]
        cases += [Case(kind, place, fault) for place in (*work, *planned) for fault in LIES]
    return cases


def drawn(count: int, seed: int) -> list[Case]:
    """Return ``count`` random cases, so that faults and places are about equally frequent."""
    dice, left, chosen = random.Random(seed), bank(), []
    seen: dict[object, int] = {}
    dice.shuffle(left)
    while left and len(chosen) < count:
        case = min(left, key=lambda c: 3 * seen.get((c.kind, c.place), 0) + seen.get(c.fault, 0))
        left.remove(case)
        chosen.append(case)
        for what in ((case.kind, case.place), case.fault):
            seen[what] = seen.get(what, 0) + 1
    return chosen


@dataclass
class Bank:
    """Runs the cases in a folder, and collects the findings."""

    root: Path
    cases: list[Case]
    findings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        (self.root / "mine").mkdir()
        for case in self.cases:
            (self.root / "mine" / f"{case.name}.py").write_text(case.text())

    def find(self, what: str) -> None:
        """Store a finding, and print it."""
        self.findings.append(what)
        print(what, flush=True)

    def bench(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run ``python -m bench`` with the plugins of the folder; forbidden output is a finding."""
        environment = {
            **os.environ, "XDG_CACHE_HOME": str(self.root / "cache"), "PYTHONPATH": os.pathsep.join(map(str, sys.path)),
        }  # fmt: skip
        # into files: a process that a plugin has started would keep a pipe open
        with open(self.root / "out.txt", "w+") as out, open(self.root / "err.txt", "w+") as err:
            done = subprocess.run(
                [sys.executable, "-c", START, *words, f"plugins={self.root / 'mine'}"],
                cwd=self.root, env=environment, stdout=out, stderr=err, timeout=3600,
            )  # fmt: skip
        done.stdout, done.stderr = ((self.root / name).read_text(errors="replace") for name in ("out.txt", "err.txt"))
        if SAID.search(done.stderr) or SAID.search(done.stdout):
            self.find(f"{words}: {SAID.findall(done.stderr + done.stdout)[:3]}: {done.stderr[-1500:]!r}")
        return done

    def listed(self) -> dict[str, str]:
        """Run ``list``; returns the line of each case that is listed as unavailable, by name."""
        done = self.bench("list")
        if done.returncode or "fobg" not in done.stdout:
            self.find(f"list ended with {done.returncode}: {done.stderr[-500:]!r}")
        lines = done.stdout.splitlines()
        found = {}
        for case in self.cases:
            own = [line for line in lines if case.name in line]
            if not own:
                self.find(f"{case.name} is not listed")
            elif any("UNAVAILABLE" in line for line in own):
                found[case.name] = own[0]
            elif case.harmful and case.place in ("import", "declared"):
                self.find(f"{case.name} is listed as sound: {own[0].strip()}")
        return found

    def run(self, kind: str, cases: list[Case]) -> None:
        """Run the cases of a kind together with a sound plugin, and verify all rows."""
        _, _, rest, axis, *_ = KINDS[kind]
        words = [*rest.split(), *WORDS, "results_dir=out"]
        alone = self.bench(*words, axis.format(""), f"name={kind}-alone")
        truth = self.rows(f"{kind}-alone")
        if alone.returncode or truth.empty:
            self.find(f"the sound {kind} ended with {alone.returncode}: {alone.stderr[-500:]!r}")
            return
        for case in [case for case in cases if case.place == "construction" and case.fault in RAISES]:
            cases.remove(case)  # the plugin cannot be built, and a command that names it must report that
            refused = self.bench("plan", *words, axis.format(f",{case.name}"), f"name={case.name}")
            if refused.returncode != 2 or "cannot be built" not in refused.stderr:
                self.find(f"{case.name} ended with {refused.returncode}: {refused.stderr[-300:]!r}")
        names = "".join(f",{case.name}" for case in cases)
        done = self.bench(*words, axis.format(names), f"name={kind}")
        rows = self.rows(kind)
        if done.returncode not in (0, 1):
            self.find(f"run of {kind} ended with {done.returncode}: {done.stderr[-700:]!r}")
            if len(cases) > 1:  # run each case separately to find the cause
                for case in cases:
                    one = self.bench(*words, axis.format(f",{case.name}"), f"name={case.name}")
                    if one.returncode not in (0, 1):
                        self.find(f"  {case.name}: {one.returncode}, {one.stderr[-300:]!r}")
            return
        for case in cases:
            own = rows[rows["parameters"].str.contains(f'"{case.name}"')]
            if own.empty:
                self.find(f"{case.name} has no row")
            for status, reason in zip(own["status"], own["reason"], strict=True):
                if (case.harmful and case.place in KINDS[kind][4] and status == "ok") or SAID.search(reason):
                    self.find(f"{case.name} has a row {status}: {reason[:200]}")
                if status != "ok" and not reason:
                    self.find(f"{case.name} has a row {status} without a reason")
        among = rows[rows["key"].isin(truth["key"])].sort_values("key").reset_index(drop=True)
        for column in set(truth) - {"stored_at", "sequence", "wall_s", "experiment"}:
            if not truth[column].equals(among[column]):
                self.find(f"the sound rows of {kind} have another {column}")

    def rows(self, name: str) -> pd.DataFrame:
        """Return the stored rows of an experiment, sorted by key."""
        return Store(self.root / "out" / name, COLUMNS).load().sort_values("key").reset_index(drop=True)

    def left(self) -> list[str]:
        """Return the command lines of processes that the commands or the plugins have started and that still run."""
        found = []
        for process in psutil.process_iter():
            try:
                mine = process.environ().get("XDG_CACHE_HOME") == str(self.root / "cache")
                if mine and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(" ".join(process.cmdline())[:100])
            except (psutil.Error, OSError):
                continue
        return found


def main(count: int, seed: int = 0) -> int:
    """Run ``count`` random cases and return the exit status."""
    with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR")) as place:
        made = Bank(Path(place), drawn(count, seed))
        unavailable, statuses = made.listed(), {}
        for case in made.cases:
            if case.name in unavailable and case.fault in ENDS:  # otherwise every command would try to import it again
                (made.root / "mine" / f"{case.name}.py").unlink()
        for kind in KINDS:
            cases = [case for case in made.cases if case.kind == kind and case.name not in unavailable]
            cases = [case for case in cases if case.place != "declared"]
            if cases:
                made.run(kind, list(cases))
                table = made.rows(kind)
                for status, number in table["status"].value_counts().items():
                    statuses[status] = statuses.get(status, 0) + int(number)
        for _ in range(100):
            if not made.left():
                break
            time.sleep(0.05)
        for line in made.left():
            made.find(f"left behind: {line}")
        print(f"{len(made.cases)} plugins of {len(bank())}: {len(unavailable)} listed as unavailable, rows {statuses}, "
              f"{len(made.findings)} findings")  # fmt: skip
        return 1 if made.findings else 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0))
