"""Imports plugin files from outside in a separate process first, so that no import can end or change a command.

A crash, ``os._exit`` or an endless loop cannot be caught within its own process, and a replaced function or another error
state would reach the rows of other plugins. A child process therefore imports each file, once in a command. It starts a line
before each, so the last one is the file that has ended it, and writes what the import has changed.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from bench.errors import printable
from bench.model import guard, isolation

TIMEOUT_S = 60.0
"""Time limit of the import of a file, in seconds."""
MARK = "BENCH_TRIAL"
"""Environment variable of a trial process and all processes that it starts."""
SHARED = ("bench", "builtins", "json", "math", "numpy", "os", "pandas", "pickle", "scipy")
"""Packages whose functions a file must not replace."""
CHILD_CODE = (
    "import json, sys; job = json.load(sys.stdin); sys.path[:] = job['path']; "
    "import bench.run.execute; from bench.model import trial; trial.run_child(job)"
)
"""The program of a trial process. It imports the runner first, so that replaced functions are noticed."""


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
        failures = _try_imports(remaining, packages, timeout_s)
        if not failures:  # if the process did not start, the import itself must report the cause
            break
        fatal |= {name: failure for name, failure in zip(remaining, failures, strict=False) if failure}
        remaining = remaining[len(failures) :]
    return fatal


def run_child(job: Mapping[str, Any]) -> None:
    """Run the trial process: import modules one by one, starting a line of output before each."""
    os.environ[MARK] = "1"
    pid = os.getpid()
    output = os.dup(1)
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    for name, folder in job["packages"].items():
        sys.modules[name] = package = ModuleType(name)
        package.__path__ = [folder]
    for name in job["modules"]:
        os.write(output, b"\n")
        state, functions, n_threads = isolation.ProcessState(), _functions(), threading.active_count()
        signal.setitimer(signal.ITIMER_REAL, job["timeout_s"])  # which ends this process
        with contextlib.suppress(BaseException):  # the registry imports the module again and lists its error
            importlib.import_module(name)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        guard.exit_if_forked(pid)
        guard.kill_children()
        now = _functions()
        replaced = [key for key, function in functions.items() if now.get(key) is not function]
        changes = [*state.changes(), *replaced[:1], *["the running threads"] * (threading.active_count() > n_threads)]
        os.write(output, printable("; ".join(changes)).encode())
        if changes:  # later files are imported in another process
            break
    os.write(output, b"\n!")
    os._exit(0)  # without waiting for threads that a plugin has left running


def _functions() -> dict[str, Any]:
    """Return the functions and classes of the modules of :data:`SHARED` by their full names."""
    modules = [(name, module) for name, module in sys.modules.items() if name.partition(".")[0] in SHARED and module]
    return {f"{name}.{key}": part for name, module in modules for key, part in vars(module).items() if callable(part)}


def _try_imports(names: Sequence[str], packages: Mapping[str, Path], timeout_s: float) -> list[str]:
    """Return how each module that was started in a trial process failed, an empty text if it passed."""
    job = {"path": sys.path, "packages": {name: str(folder) for name, folder in packages.items()}}
    content = json.dumps(job | {"modules": list(names), "timeout_s": timeout_s}).encode()
    with guard.temporary_file() as output:
        process = subprocess.Popen(
            [sys.executable, "-c", CHILD_CODE], stdin=subprocess.PIPE, stdout=output, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        try:
            process.communicate(content)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        lines = os.pread(output.fileno(), os.fstat(output.fileno()).st_size, 0).decode().split("\n")[1:]
    failures = [f"changed {text} when it was imported" * bool(text) for text in lines[:-1]]
    code = process.wait()
    if not lines or lines[-1] == "!":
        return failures
    cause = f"ended the process {f'by {signal.Signals(-code).name}' if code < 0 else f'(exit status {code})'}"
    if code == -signal.SIGALRM:
        cause = f"did not return within {timeout_s:g} s"
    return [*failures, f"{cause} when it was imported"]
