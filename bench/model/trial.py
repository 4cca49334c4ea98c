"""New plugin files are first tried in a process of their own: one that ends it is listed, and ends no command.

A crash, ``os._exit`` or an endless loop cannot be caught where it happens. So each file is imported there, and its plugins
are built with their defaults and asked what a run asks while it is planned. A file that came through once is not tried
again until its text changes: its hash stands in ``$XDG_CACHE_HOME/bench/imported`` (``~/.cache`` where that is not set). Where that folder cannot be written, each command tries again, which costs about a second.
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

PATIENCE = 60.0
"""Seconds that one module may take."""
STAGES = {b".": "when it was imported", b",": "when it was built with its defaults and asked what a plan asks"}
"""What a module was at, by the last sign from its process."""
CHILD = "import json, sys; given = json.load(sys.stdin); sys.path[:] = given['path']; import bench.model.trial as t; t.child(given)"


def fatal(
    modules: Mapping[str, str], packages: Mapping[str, Path] = MappingProxyType({}), patience: float | None = None
) -> dict[str, str]:
    """Return what happened to the process that imported a module, for each one that ended it or did not come back.

    ``modules`` maps names to what tells one text from another (:func:`stamp`); ``packages`` are names that stand for
    plugin folders. What merely raises is not fatal.
    """
    known = _known()
    waiting = [name for name, text in modules.items() if _digest(name, text) not in known]
    found: dict[str, str] = {}
    while waiting:
        came, end = _import(waiting, packages, PATIENCE if patience is None else patience)
        passed = waiting[: came - 1] if end else waiting
        if end and not came:
            return found  # the process could not start: nothing can be told, and the import says why
        if end:
            found[waiting[came - 1]] = end
        _remember([_digest(name, modules[name]) for name in passed])
        waiting = waiting[came:] if end else []
    return found


def stamp(module: str) -> str:
    """Return the text of a module's file as a hash; empty where there is none to read."""
    try:
        spec = importlib.util.find_spec(module)
        return hashlib.sha256(Path(spec.origin).read_bytes()).hexdigest() if spec and spec.origin else ""
    except (ImportError, OSError, ValueError):
        return ""


def child(given: Mapping[str, Any]) -> None:
    """Try modules one by one; the pipe hears of each before it is imported, before its plugins are built, and of the end."""
    own = os.getpid()
    pipe = os.dup(1)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(nowhere, descriptor)
    for name, folder in given["packages"].items():
        sys.modules[name] = package = ModuleType(name)
        package.__path__ = [folder]
    for name in given["modules"]:
        os.write(pipe, b".")
        with contextlib.suppress(BaseException):  # it is imported again where its error is listed
            module = importlib.import_module(name)
            os.write(pipe, b"," if os.getpid() == own else b"")
            _ask(module)
        guard.end_copies(own)
        guard.end_children()
    os.write(pipe, b"!")
    os._exit(0)  # threads that a plugin has left running keep nothing waiting


def _ask(module: ModuleType) -> None:
    """Build the plugins of a module and ask each what a plan asks; an answer that raises is one of a cell."""
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
    questions: dict[str, dict[str, tuple[Any, ...]]] = {
        "scenes": {"theta0": (), "breakpoints": (), "closed_form_gradient": (None, None)},
        "contacts": {"spring": ()},
        "integrators": {"transition": (0.01, 1.0, 0.1, 1.0)},
        "backends": {"incompatibility": (program,)},
        "estimators": {"incompatibility": (program, CAPABILITIES, "numpy")},
    }
    for plugin in list(vars(module).values()):
        with contextlib.suppress(Exception):
            if isinstance(plugin, type) and issubclass(plugin, Plugin) and plugin.__module__ == module.__name__:
                made = plugin()
                for question, given in questions.get(plugin.kind, {}).items():
                    with contextlib.suppress(Exception):
                        getattr(made, question)(*given)


def _import(names: Sequence[str], packages: Mapping[str, Path], patience: float) -> tuple[int, str]:
    """Return how many modules a process came to, and how the last one ended it; empty where all came through."""
    command = [sys.executable, "-c", CHILD]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    given = {
        "path": sys.path,
        "packages": {name: str(folder) for name, folder in packages.items()},
        "modules": list(names),
    }
    with subprocess.Popen(command, start_new_session=True, **pipes) as process:  # type: ignore[call-overload]
        try:
            process.stdin.write(json.dumps(given).encode())
            process.stdin.close()
        except BrokenPipeError:
            return 0, "did not start"
        came, said, stage = 0, b"", "when it was imported"
        try:
            with selectors.DefaultSelector() as selector:
                selector.register(process.stdout, selectors.EVENT_READ)
                until = time.monotonic() + patience
                while selector.select(max(0.0, until - time.monotonic())):
                    said = os.read(process.stdout.fileno(), 4096)
                    came += said.count(b".")
                    stage = STAGES.get(said[-1:], stage)
                    if not said or said.endswith(b"!"):
                        break
                    until = time.monotonic() + patience
                else:
                    return came, f"did not come back within {patience:g} s {stage}"
        finally:
            _end(process)
    return came, "" if said.endswith(b"!") else f"{_how(process.returncode)} {stage}"


def _end(process: subprocess.Popen[bytes]) -> None:
    """Wait a moment for a process that has said its last word, then kill what it has started with it."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(0.5)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _how(status: int) -> str:
    return (
        f"ended the process by {signal.Signals(-status).name}"
        if status < 0
        else f"ended the process (exit status {status})"
    )


def _digest(name: str, text: str) -> str:
    """Return what is remembered of a module: its name's last part, its text, and the Python that imported it."""
    return hashlib.sha256(f"asked {name.rpartition('.')[2]} {text} {sys.version}".encode()).hexdigest()[:24]


def _place() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "bench" / "imported"


def _known() -> frozenset[str]:
    try:
        return frozenset(_place().read_text().split())
    except (OSError, UnicodeDecodeError, RuntimeError):
        return frozenset()


def _remember(digests: Sequence[str]) -> None:
    try:
        place = _place()
        place.parent.mkdir(parents=True, exist_ok=True)
        with place.open("a") as file:
            file.write("".join(f"{digest}\n" for digest in digests))
    except (OSError, RuntimeError):
        return
