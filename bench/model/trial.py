"""Imports plugin files from outside in a separate process first, so that a file that crashes cannot end a command.

A crash, ``os._exit`` or an endless loop cannot be caught within its own process. A child process therefore imports each file,
once in a command, and writes a byte before each: the last one is the file that has ended it.
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
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from bench.model import guard

TIMEOUT_S = 60.0
"""Time limit of the import of a file, in seconds."""
MARK = "BENCH_TRIAL"
"""Environment variable of a trial process and all processes that it starts."""
CHILD_CODE = (
    "import json, sys; job = json.load(sys.stdin); sys.path[:] = job['path']; "
    "import bench.model.trial as trial; trial.run_child(job)"
)


def find_fatal_modules(
    modules: Sequence[str], packages: Mapping[str, Path], timeout_s: float | None = None
) -> dict[str, str]:
    """Return the failure message of each module that ended or blocked the trial process, by module name.

    ``packages`` maps package names of plugin folders to the folders. A module that only raises an exception is not fatal.
    """
    if MARK in os.environ:  # a module of a plugin folder that adds folders itself would start trials without end
        return {}
    remaining, fatal = list(modules), {}
    while remaining:
        n_started, failure = _try_imports(remaining, packages, TIMEOUT_S if timeout_s is None else timeout_s)
        if not failure or not n_started:  # if the process did not start, the import itself must report the cause
            break
        fatal[remaining[n_started - 1]] = failure
        remaining = remaining[n_started:]
    return fatal


def run_child(job: Mapping[str, Any]) -> None:
    """Run the trial process: import modules one by one, writing a byte to the pipe before each."""
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
        os.write(pipe, b".")
        with contextlib.suppress(BaseException):  # the registry imports the module again and lists its error
            importlib.import_module(name)
        guard.exit_if_forked(pid)
        guard.kill_children()
    os.write(pipe, b"!")
    os._exit(0)  # without waiting for threads that a plugin has left running


def _try_imports(names: Sequence[str], packages: Mapping[str, Path], timeout_s: float) -> tuple[int, str]:
    """Return the number of modules started in a trial process, and how the last one failed (empty if all passed)."""
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
            return 0, "did not start"
        n_started, received = 0, b""
        try:
            with selectors.DefaultSelector() as selector:
                selector.register(process.stdout, selectors.EVENT_READ)
                deadline = time.monotonic() + timeout_s
                while selector.select(max(0.0, deadline - time.monotonic())):
                    received = os.read(process.stdout.fileno(), 4096)
                    n_started += received.count(b".")
                    if not received or received.endswith(b"!"):
                        break
                    deadline = time.monotonic() + timeout_s
                else:
                    return n_started, f"did not return within {timeout_s:g} s when it was imported"
        finally:
            _terminate(process)
    code = process.returncode
    cause = f"by {signal.Signals(-code).name}" if code < 0 else f"(exit status {code})"
    return n_started, "" if received.endswith(b"!") else f"ended the process {cause} when it was imported"


def _terminate(process: subprocess.Popen[bytes]) -> None:
    """Wait up to 0.5 s for the process to exit, then kill it and the processes that it has started."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(0.5)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
