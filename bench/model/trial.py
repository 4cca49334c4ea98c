"""Imports new plugin files in a separate trial process first, so that a crashing file cannot end a command.

A crash, ``os._exit`` or an endless loop cannot be caught within its own process. The trial process therefore imports
each new file, builds its plugins with their defaults and calls the methods that are called when a run is planned. A
file that passes is not tried again until its content changes: its hash is stored in ``$XDG_CACHE_HOME/bench/imported``
(by default under ``~/.cache``). If that file cannot be written, each command repeats the trial, which takes about a
second.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

from bench.model import guard

TIMEOUT_S = 60.0
"""Time limit of each stage of a module's trial, in seconds."""
STAGES = {b".": "when it was imported", b",": "when it was built with its defaults and called as for a plan"}
"""Stage of a module's trial, by the byte that the trial process writes at its start."""
MARK = "BENCH_TRIAL"
"""Environment variable of a trial process and all processes that it starts."""
CHILD_CODE = (
    "import json, sys; job = json.load(sys.stdin); sys.path[:] = job['path']; "
    "import bench.model.trial as trial; trial.run_child(job)"
)


def find_fatal_modules(
    modules: Mapping[str, str],
    packages: Mapping[str, Path] = MappingProxyType({}),
    timeout_s: float | None = None,
) -> dict[str, str]:
    """Return the failure message of each module that ended or blocked the trial process, by module name.

    ``modules`` maps module names to the hashes of their files (:func:`file_hash`). ``packages`` maps package names of
    plugin folders to the folders. A module that only raises an exception is not fatal.
    """
    if MARK in os.environ:  # a module of a plugin folder that adds folders itself would start trials without end
        return {}
    passed = _load_digests()
    remaining = [name for name, text in modules.items() if _digest(name, text) not in passed]
    fatal: dict[str, str] = {}
    while remaining:
        n_started, failure = _try_imports(remaining, packages, TIMEOUT_S if timeout_s is None else timeout_s)
        if failure and not n_started:
            return fatal  # the trial process did not start, so the import itself must report the cause
        n_passed = n_started - 1 if failure else len(remaining)
        _store_digests([_digest(name, modules[name]) for name in remaining[:n_passed]])
        if failure:
            fatal[remaining[n_passed]] = failure
        remaining = remaining[n_passed + 1 :]
    return fatal


def file_hash(module: str) -> str:
    """Return the hash of a module's file, or an empty string if the file cannot be read."""
    try:
        spec = importlib.util.find_spec(module)
        return hashlib.sha256(Path(spec.origin).read_bytes()).hexdigest() if spec and spec.origin else ""
    except (ImportError, OSError, ValueError):
        return ""


def run_child(job: Mapping[str, Any]) -> None:
    """Run the trial process: import and call modules one by one, writing a byte to the pipe before each stage."""
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
            module = importlib.import_module(name)
            os.write(pipe, b"," if os.getpid() == pid else b"")
            _call_plugins(module)
        guard.exit_if_forked(pid)
        guard.kill_children()
    os.write(pipe, b"!")
    os._exit(0)  # without waiting for threads that a plugin has left running


def _call_plugins(module: ModuleType) -> None:
    """Build a module's plugins and call their methods as when a run is planned. Ignore exceptions: cells report them."""
    import numpy as np

    from bench.model.backend import CAPABILITIES
    from bench.model.parameters import Plugin
    from bench.model.program import compose
    from bench.model.scene import FunctionScene

    class Bowl(FunctionScene):
        def theta0(self) -> Any:
            return np.zeros(1)

        def cost(self, xp: Any, x: Any) -> Any:
            return x[0] * x[0]

    program = compose(Bowl(), None, None)
    calls: dict[str, dict[str, tuple[Any, ...]]] = {
        "scenes": {"theta0": (), "breakpoints": (), "closed_form_gradient": (None, None)},
        "contacts": {"spring": ()},
        "integrators": {"transition": (0.01, 1.0, 0.1, 1.0)},
        "backends": {"incompatibility": (program,)},
        "estimators": {"incompatibility": (program, CAPABILITIES, "numpy")},
    }
    for plugin in list(vars(module).values()):
        with contextlib.suppress(Exception):
            if isinstance(plugin, type) and issubclass(plugin, Plugin) and plugin.__module__ == module.__name__:
                instance = plugin()
                for method, arguments in calls.get(plugin.kind, {}).items():
                    with contextlib.suppress(Exception):
                        getattr(instance, method)(*arguments)


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
        n_started, received, stage = 0, b"", "when it was imported"
        try:
            with selectors.DefaultSelector() as selector:
                selector.register(process.stdout, selectors.EVENT_READ)
                deadline = time.monotonic() + timeout_s
                while selector.select(max(0.0, deadline - time.monotonic())):
                    received = os.read(process.stdout.fileno(), 4096)
                    n_started += received.count(b".")
                    stage = STAGES.get(received[-1:], stage)
                    if not received or received.endswith(b"!"):
                        break
                    deadline = time.monotonic() + timeout_s
                else:
                    return n_started, f"did not return within {timeout_s:g} s {stage}"
        finally:
            _terminate(process)
    return n_started, "" if received.endswith(b"!") else f"{_exit_description(process.returncode)} {stage}"


def _terminate(process: subprocess.Popen[bytes]) -> None:
    """Wait up to 0.5 s for the process to exit, then kill it and the processes that it has started."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(0.5)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _exit_description(status: int) -> str:
    cause = f"by {signal.Signals(-status).name}" if status < 0 else f"(exit status {status})"
    return f"ended the process {cause}"


def _digest(name: str, text: str) -> str:
    """Return the stored hash of a module that passed: of its last name, its file hash and the Python version."""
    return hashlib.sha256(f"asked {name.rpartition('.')[2]} {text} {sys.version}".encode()).hexdigest()[:24]


def _digests_path() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "bench" / "imported"


def _load_digests() -> frozenset[str]:
    try:
        return frozenset(_digests_path().read_text().split())
    except (OSError, UnicodeDecodeError, RuntimeError):
        return frozenset()


def _store_digests(digests: Sequence[str]) -> None:
    try:
        path = _digests_path()
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write("".join(f"{digest}\n" for digest in digests))
    except (OSError, RuntimeError):
        return
