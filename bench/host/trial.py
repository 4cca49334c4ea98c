"""Imports plugin files from outside in a separate process first, so that no import can end a command or change its numbers.

A function of a library that a file replaces would compute numbers of other plugins too. A crash, ``os._exit`` or an
endless loop cannot be caught within its own process. A child process therefore imports each file, once in a command. It
writes a line before each, so the last one is the file that has ended it.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from bench.host import guard

TIMEOUT_S = 60.0
"""Time limit of the import of a file, in seconds."""
MARK = "BENCH_TRIAL"
"""Environment variable of a trial process and all processes that it starts."""
CHILD_CODE = (
    "import json, sys; job = json.load(sys.stdin); sys.path[:] = job['path']; "
    "from bench.host import trial; trial.run_child(job)"
)
"""The program of a trial process."""


def find_fatal_modules(
    modules: Sequence[str], packages: Mapping[str, Path], timeout_s: float = TIMEOUT_S
) -> dict[str, str]:
    """Return the failure message of each module that ended, blocked or changed the trial process, by module name.

    ``packages`` maps package names of plugin folders to the folders. A module that only raises an exception is not fatal.
    """
    if MARK in os.environ:  # a module of a plugin folder that adds folders itself would start trials without end
        return {}
    remaining = list(modules)
    fatal: dict[str, str] = {}
    while remaining:
        n_started, failure = _try_imports(remaining, packages, timeout_s)
        if failure and n_started:  # if the process did not start, the import itself must report the cause
            fatal[remaining[n_started - 1]] = failure
        remaining = remaining[n_started:] if failure and n_started else []
    return fatal


def run_child(job: Mapping[str, Any]) -> None:
    """Run the trial process: import modules one by one, writing a line before each."""
    os.environ[MARK] = "1"
    pid = os.getpid()
    output = os.dup(1)
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    for name, folder in job["packages"].items():
        sys.modules[name] = package = ModuleType(name)
        package.__path__ = [folder]
    importlib.import_module("bench.model")  # what plugins build on, with its libraries
    before = guard.library_functions()
    for name in job["modules"]:
        os.write(output, b"\n")
        signal.setitimer(signal.ITIMER_REAL, job["timeout_s"])  # which ends this process
        with contextlib.suppress(BaseException):  # the registry imports the module again and lists its error
            importlib.import_module(name)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        guard.exit_if_forked(pid)
        if changed := guard.replaced(before):
            os.write(output, changed.encode())
            os._exit(1)
    os.write(output, b"!")
    os._exit(0)  # without waiting for threads that a plugin has left running


def _try_imports(names: Sequence[str], packages: Mapping[str, Path], timeout_s: float) -> tuple[int, str]:
    """Return how many modules a trial process has started to import, and how the last one ended it; empty if none did."""
    job = {"path": sys.path, "packages": {name: str(folder) for name, folder in packages.items()}}
    content = json.dumps(job | {"modules": list(names), "timeout_s": timeout_s}).encode()
    with guard.temporary_file() as output:
        process = subprocess.Popen(
            [sys.executable, "-c", CHILD_CODE],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            process.communicate(content)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        written = os.pread(output.fileno(), len(names) + 200, 0)
    code, n_started, last = process.wait(), written.count(b"\n"), written.rpartition(b"\n")[2].decode(errors="replace")
    if last == "!":
        return n_started, ""
    if last:
        return n_started, f"replaced {last} when it was imported"
    cause = f"ended the process {f'by {signal.Signals(-code).name}' if code < 0 else f'(exit status {code})'}"
    if code == -signal.SIGALRM:
        cause = f"did not return within {timeout_s:g} s"
    return n_started, f"{cause} when it was imported"
