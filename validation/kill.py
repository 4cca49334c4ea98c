"""Kills runs at random moments of every phase, and counts losses: ``python validation/kill.py COUNT [SEED]``.

A round starts in an empty folder and consists of the phases of a run (references, cells, tables, page) and a comparison with
a sweep that was never killed. In each phase the run is killed a few times and started again. Each kill has a random victim
(the run, a child process, the process group), a random signal and a random moment within the phase; a run that outlives the
kill of a child is killed again. A kill counts if the victim was alive, for the phase in which the run was at that moment.
The runs of every fifth round are processes of their own from the first import on; the others are forked from a process that
has imported the package, which takes a tenth of the time. Prints the faults and counts; the exit status is 1 for any fault.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pandas as pd
import psutil
from exact import by_key, differences

from bench.run.files import TEMPORARY
from bench.run.store import Store
from bench.studies.bias_variance.columns import COLUMNS

KILLS = {"references": 4, "cells": 8, "tables": 3, "page": 3, "compare": 3}
"""Number of killed runs per phase in a round."""
MOST = 1
"""Kills of children of one run; then the run itself is the victim. A cell that loses two workers is stored as crashed."""
OWN = 5
"""Each round of this number starts its runs as processes of their own."""
CELLS = 32
WORDS = [
    "scenes=[soft_heaviside]", "backends=[numpy]", "estimators=[fobg,reinforce]", "repeats=4", "samples=256",
    "timing=false", "workers=2", "--quiet", "name=sweep", "reference.samples=4096", "results_dir=.",
    "sweep.sigma=[0.1,0.11,0.12,0.13]", "sweep.seed=[0,1,2,3]",
]  # fmt: skip
MARKS = """
import json, os, runpy, signal, sys, time
def mark(phase):
    with open(os.environ["PHASES"], "a") as file:
        file.write(f"{phase} {time.time()}\\n")
def marked(owner, name, phase):
    real = getattr(owner, name)
    def call(*given, **more):
        mark(phase)
        return real(*given, **more)
    setattr(owner, name, call)
from bench.compare import command as compare
from bench.report import finish, web
from bench.run import execute, runner
answers = runner._Run._answers
def marked_answers(self, tasks, pool):
    if tasks:
        mark("references" if tasks[0].reference else "cells")
    return answers(self, tasks, pool)
runner._Run._answers = marked_answers
marked(execute, "_compact", "folding")
marked(finish, "write", "tables")
marked(web, "write", "page")
marked(compare, "main", "compare")
def run():
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it in its background jobs
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        runpy.run_module("bench", run_name="__main__", alter_sys=True)
    finally:
        for name in (signal.SIGINT, signal.SIGTERM):
            signal.signal(name, signal.SIG_IGN)  # the command has ended
        mark("end")
"""
"""Defines ``run``, the command ``python -m bench``, which also writes the start of each phase to the file ``PHASES``."""
START = f"{MARKS}\nrun()"
SERVER = f"""{MARKS}
import matplotlib.backends.backend_agg, matplotlib.figure, pandas, pyarrow.parquet, scipy.stats
from bench.report import draw
for line in sys.stdin:
    folder, words, phases, errors = json.loads(line)
    if not (pid := os.fork()):
        os.setsid()
        os.chdir(folder)
        for number, path in enumerate((os.devnull, os.devnull, errors)):
            os.dup2(os.open(path, os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        os.environ["PHASES"], sys.argv = phases, ["bench", *words]
        run()
        sys.exit(0)
    print(pid, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""
"""Runs a command per line of standard input, in a process forked from this one; prints its number, then its exit status."""


class Server:
    """The process from which runs are forked."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    def start(self, *what: Any) -> int:
        """Fork a run; returns the number of its process."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(what) + "\n")
        self.process.stdin.flush()
        return int(self.line())

    def answers(self, seconds: float) -> bool:
        assert self.process.stdout is not None
        return bool(select.select([self.process.stdout], [], [], seconds)[0])

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline()


class Run:
    """A command running in a folder, and the phases that it has started."""

    def __init__(self, server: Server | None, folder: Path, *words: str) -> None:
        self._phases, self._errors = folder.with_name("phases.txt"), folder.with_name("errors.txt")
        self._phases.write_text("")
        self._server, self.status = server, None
        if server is not None:
            self.pid = server.start(str(folder), words, str(self._phases), str(self._errors))
            return
        with self._errors.open("w") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-c", START, *words], cwd=folder, env=os.environ | {"PHASES": str(self._phases)},
                stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True,
            )  # fmt: skip
        self.pid = self._process.pid

    status: int | None

    def phases(self) -> list[tuple[str, float]]:
        """Return the phases that the command has started, each with its time [s since 1970]."""
        lines = [line.split() for line in self._phases.read_text().splitlines()]
        return [(line[0], float(line[1])) for line in lines if len(line) == 2]

    def poll(self, seconds: float = 0.0) -> int | None:
        """Return the exit status, or None if the command still runs after ``seconds``."""
        if self.status is None and self._server is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.status = self._process.wait(seconds)
        elif self.status is None and self._server is not None and self._server.answers(seconds):
            self.status = int(self._server.line())
        return self.status

    def reaches(self, phase: str) -> bool:
        """Wait until a phase starts; returns False if the command ends without it."""
        while phase not in dict(self.phases()):
            if self.poll() is not None:
                return phase in dict(self.phases())
            time.sleep(0.01)
        return True

    def end(self) -> str:
        """Wait until the command ends; returns its stderr."""
        assert self.poll(600.0) is not None, "the command does not end"
        return self._errors.read_text(errors="replace")


def words_of(phase: str) -> list[str]:
    return ["compare", "sweep", "../whole/sweep"] if phase == "compare" else WORDS


def left_in(folder: Path) -> list[psutil.Process]:
    found = []
    for process in psutil.process_iter():
        try:
            if process.cwd() == str(folder) and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except psutil.Error:
            continue
    return found


def rows_of(folder: Path) -> dict[str, dict[str, Any]]:
    return by_key(Store(folder / "sweep", COLUMNS).load())


def broken(path: Path) -> bool:
    """Return whether a file is incomplete or unreadable; False if it does not exist."""
    ends = {".png": b"IEND\xaeB\x60\x82", ".html": b"</html>", ".csv": b"\n", ".md": b"\n"}
    try:
        content = path.read_bytes()
        if path.suffix == ".json":
            json.loads(content)
        elif path.suffix == ".parquet":
            pd.read_parquet(path)
    except FileNotFoundError:
        return False
    except Exception:
        return True
    end = ends.get(path.suffix, b"")
    return not (content.endswith(end) or content.rstrip().endswith(end))


class Kills:
    """Runs rounds of kills, and counts kills and faults."""

    def __init__(self, place: Path, seed: int, server: Server) -> None:
        self._server = server
        self.whole, self.cut, self.dice = place / "whole", place / "cut", random.Random(seed)
        self.done: Counter[str] = Counter()
        self.by: Counter[str] = Counter()
        self.rounds = 0
        names = ("lost", "changed", "orphans", "temporary", "half files", "tracebacks", "failed")
        self.faults = dict.fromkeys(names, 0)
        self.whole.mkdir()
        self._lasts: dict[str, float] = {}
        for phase in ("cells", "compare"):
            run = Run(server, self.whole, *(["compare", "sweep", "sweep"] if phase == "compare" else WORDS))
            said = run.end()
            assert run.status == 0, said
            came = run.phases()
            self._lasts |= {one: end - start for (one, start), (_, end) in itertools.pairwise(came)}
        self.truth = rows_of(self.whole)
        assert len(self.truth) == CELLS

    def fault(self, what: str, more: str) -> None:
        """Count a fault and print it."""
        self.faults[what] += 1
        print(f"{what}: {more[-1500:]}", flush=True)

    def compare(self, rows: dict[str, dict[str, Any]], what: str) -> None:
        """Count a fault if rows differ in any bit from the rows of the sweep that was never killed."""
        if found := differences(rows, self.truth):
            self.fault("changed", f"{what}: {len(found)} values, {found[:5]}")

    def round(self, count: int) -> None:
        """Kill in every phase, then finish the sweep and verify that it equals the sweep that was never killed."""
        self.cut.mkdir()
        for phase, times in KILLS.items():
            for _ in range(times):
                if self.done.total() < count:
                    self.kill(phase)
        for phase in ("cells", "compare"):  # merges files, and removes those that kills have left
            run = self.start(phase)
            said = run.end()
            if run.status not in (0, 1):
                self.fault("failed", f"{phase} {run.status} {said}")
        self.compare(whole := rows_of(self.cut), "the whole sweep")
        if len(whole) != CELLS:
            self.fault("lost", f"the whole sweep has {len(whole)} rows")
        for path in self.cut.rglob(".*"):
            if TEMPORARY.fullmatch(path.name):
                self.fault("temporary", str(path))
        shutil.rmtree(self.cut)
        self.rounds += 1

    def start(self, phase: str) -> Run:
        """Start the command that has the phase."""
        return Run(self._server if (self.rounds + 1) % OWN else None, self.cut, *words_of(phase))

    def room_for(self, phase: str) -> None:
        """Remove the results of a phase that a surviving run has finished, so that the next run has the phase again."""
        if phase in ("references", "cells") and len(rows_of(self.cut)) == CELLS:
            for name in ("references", "sweep") if phase == "references" else ("sweep",):
                shutil.rmtree(self.cut / name, ignore_errors=True)

    def kill(self, phase: str) -> None:
        """Start the command, kill children and then the run during the phase, and count faults in the results."""
        self.room_for(phase)
        run, kills = self.start(phase), []
        run.reaches(phase)
        before = rows_of(self.cut)
        for number in range(MOST + 1):
            lasts = 0.6 * self._lasts.get(phase, 0.5)  # the next run has less to do
            if run.poll(self.dice.uniform(0.0, lasts)) is not None:
                break
            kills.append(what := self.strike(run, run.phases()[-1][0] if run.phases() else "start", number == MOST))
            if not what.endswith("child"):
                break
        said, what = run.end(), ", ".join(kills)
        if "Traceback" in said:
            self.fault("tracebacks", f"{what}: {said}")
        after = rows_of(self.cut)
        lost = before.keys() - after.keys()
        if lost:
            self.fault("lost", f"{what}: {len(lost)} rows")
        self.compare(after, what)
        until = time.monotonic() + 5.0
        while left_in(self.cut) and time.monotonic() < until:
            time.sleep(0.05)
        for orphan in left_in(self.cut):
            self.fault("orphans", f"{what}: {orphan}")
            with contextlib.suppress(psutil.Error):
                orphan.kill()
        for path in self.cut.rglob("[!.]*"):
            if path.is_file() and broken(path):
                self.fault("half files", f"{what}: {path}")

    def strike(self, run: Run, at: str, last: bool) -> str:
        """Send a random signal to a random victim, the run itself if it is the last strike; returns what was done."""
        children = []
        with contextlib.suppress(psutil.Error):
            children = psutil.Process(run.pid).children()
        victim = self.dice.choice(["run", "child", "child", "group"] if children and not last else ["run", "group"])
        sent = self.dice.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGSTOP])
        alive = True
        try:
            if victim == "run":
                os.kill(run.pid, sent)
            elif victim == "group":
                os.killpg(run.pid, sent)
            else:
                self.dice.choice(children).send_signal(sent)
        except (ProcessLookupError, psutil.Error):
            alive = False
        if sent == signal.SIGSTOP and victim != "child":
            time.sleep(0.3)
            with contextlib.suppress(ProcessLookupError):
                os.kill(run.pid, signal.SIGKILL)
        if alive and at != "end":
            self.done[at] += 1
            self.by[f"{sent.name[3:]} {victim}"] += 1
        return f"{sent.name} in {at} to {victim}"


def main(count: int, seed: int) -> int:
    with tempfile.TemporaryDirectory() as place, Server() as server:
        kills = Kills(Path(place).resolve(), seed, server)
        while kills.done.total() < count:
            kills.round(count)
            print(f"{kills.done.total()} kills", flush=True)
        print(
            f"{kills.done.total()} kills ({dict(kills.done)}; {dict(kills.by)}), {kills.rounds} rounds: {kills.faults}"
        )
        return 1 if any(kills.faults.values()) else 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0))
