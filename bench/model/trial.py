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
import selectors
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
    "import bench.run.execute; import bench.model.trial as trial; trial.run_child(job)"
)


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
    """Run the trial process: import modules one by one, writing a line to the pipe for each."""
    os.environ[MARK] = "1"
    pid = os.getpid()
    pipe = os.dup(1)
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    for name, folder in job["packages"].items():
        sys.modules[name] = package = ModuleType(name)
        package.__path__ = [folder]
    for name in job["modules"]:
        os.write(pipe, b"\n")
        state, functions, n_threads = isolation.ProcessState(), _functions(), threading.active_count()
        with contextlib.suppress(BaseException):  # the registry imports the module again and lists its error
            importlib.import_module(name)
        guard.exit_if_forked(pid)
        guard.kill_children()
        now = _functions()
        replaced = [key for key, function in functions.items() if now.get(key) is not function]
        changes = [*state.changes(), *replaced[:1], *["the running threads"] * (threading.active_count() > n_threads)]
        os.write(pipe, printable("; ".join(changes)).encode())
        if changes:  # later files are imported in another process
            break
    os.write(pipe, b"\n!")
    os._exit(0)  # without waiting for threads that a plugin has left running


def _functions() -> dict[str, Any]:
    """Return the functions and classes of the modules of :data:`SHARED` by their full names."""
    modules = [(name, module) for name, module in sys.modules.items() if name.partition(".")[0] in SHARED and module]
    return {f"{name}.{key}": part for name, module in modules for key, part in vars(module).items() if callable(part)}


def _try_imports(names: Sequence[str], packages: Mapping[str, Path], timeout_s: float) -> list[str]:
    """Return how each module that was started in a trial process failed, an empty text if it passed."""
    command = [sys.executable, "-c", CHILD_CODE]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    job = {
        "path": sys.path,
        "packages": {name: str(folder) for name, folder in packages.items()},
        "modules": list(names),
    }
    with subprocess.Popen(command, start_new_session=True, **pipes) as process:  # type: ignore[call-overload]
        try:
            process.stdin.write(json.dumps(job).encode())
            process.stdin.close()
        except BrokenPipeError:
            return []
        output, cause = b"", ""
        try:
            with selectors.DefaultSelector() as selector:
                selector.register(process.stdout, selectors.EVENT_READ)
                while not output.endswith(b"\n!"):
                    if not selector.select(timeout_s):
                        cause = f"did not return within {timeout_s:g} s"
                        break
                    received = os.read(process.stdout.fileno(), 4096)
                    if not received:
                        break
                    output += received
        finally:
            _terminate(process)
    *changes, last = output.decode().split("\n")[1:] or [""]
    failures = [f"changed {text} when it was imported" * bool(text) for text in changes]
    if last == "!" or not output:
        return failures
    code = process.returncode
    cause = cause or f"ended the process {f'by {signal.Signals(-code).name}' if code < 0 else f'(exit status {code})'}"
    return [*failures, f"{cause} when it was imported"]


def _terminate(process: subprocess.Popen[bytes]) -> None:
    """Wait up to 0.5 s for the process to exit, then kill it and the processes that it has started."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(0.5)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
