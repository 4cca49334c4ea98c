"""Kills runs at random moments of every phase, and counts losses: ``python validation/kill.py COUNT [SEED]``.

A round starts in an empty folder and consists of the phases of a run (references, cells, tables, page) and a comparison with
a sweep that was never killed. In each phase the run is killed a few times and started again. Each kill has a random victim
(the run, a child process, the process group), a random signal and a random moment within the phase; a run that outlives the
kill of a child is killed again. A kill counts if the victim was alive, for the phase in which the run was at that moment.
Prints the faults and counts; the exit status is 1 for any fault.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import random
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


class Run:
    """A command running in a folder, and the phases that it has started."""

    def __init__(self, folder: Path, *words: str) -> None:
        self._phases, self._errors = folder.with_name("phases.txt"), folder.with_name("errors.txt")
        self._phases.write_text("")
        with self._errors.open("w") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-c", START, *words], cwd=folder, env=os.environ | {"PHASES": str(self._phases)},
                stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True,
            )  # fmt: skip
        self.pid = self._process.pid

    @property
    def status(self) -> int | None:
        """The exit status, or None while the command runs."""
        return self._process.poll()

    def phases(self) -> list[tuple[str, float]]:
        """Return the phases that the command has started, each with its time [s since 1970]."""
        lines = [line.split() for line in self._phases.read_text().splitlines()]
        return [(line[0], float(line[1])) for line in lines if len(line) == 2]

    def ends_within(self, seconds: float) -> bool:
        """Wait at most ``seconds``; returns whether the command has ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        return self.status is not None

    def wait_for(self, phase: str) -> None:
        """Wait until a phase starts or the command ends."""
        while phase not in dict(self.phases()) and self.status is None:
            time.sleep(0.01)

    def end(self) -> str:
        """Wait until the command ends; returns its stderr."""
        assert self.ends_within(600.0), "the command does not end"
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

    def __init__(self, place: Path, seed: int) -> None:
        self.whole, self.cut, self.dice = place / "whole", place / "cut", random.Random(seed)
        self.done: Counter[str] = Counter()
        self.by: Counter[str] = Counter()
        self.rounds = 0
        names = ("lost", "changed", "orphans", "temporary", "half files", "tracebacks", "failed")
        self.faults = dict.fromkeys(names, 0)
        self.whole.mkdir()
        self._lasts: dict[str, float] = {}
        for phase in ("cells", "compare"):
            run = Run(self.whole, *(["compare", "sweep", "sweep"] if phase == "compare" else WORDS))
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
            run = Run(self.cut, *words_of(phase))
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

    def room_for(self, phase: str) -> None:
        """Remove the results of a phase that a surviving run has finished, so that the next run has the phase again."""
        if phase in ("references", "cells") and len(rows_of(self.cut)) == CELLS:
            for name in ("references", "sweep") if phase == "references" else ("sweep",):
                shutil.rmtree(self.cut / name, ignore_errors=True)

    def kill(self, phase: str) -> None:
        """Start the command, kill children and then the run during the phase, and count faults in the results."""
        self.room_for(phase)
        run, kills = Run(self.cut, *words_of(phase)), []
        run.wait_for(phase)
        before = rows_of(self.cut)
        for number in range(MOST + 1):
            lasts = 0.6 * self._lasts.get(phase, 0.5)  # the next run has less to do
            if run.ends_within(self.dice.uniform(0.0, lasts)):
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
    with tempfile.TemporaryDirectory() as place:
        kills = Kills(Path(place).resolve(), seed)
        while kills.done.total() < count:
            kills.round(count)
            print(f"{kills.done.total()} kills", flush=True)
        print(
            f"{kills.done.total()} kills ({dict(kills.done)}; {dict(kills.by)}), {kills.rounds} rounds: {kills.faults}"
        )
        return 1 if any(kills.faults.values()) else 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0))
