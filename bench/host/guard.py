"""Protects the process from side effects of plugins: working folder, forks and terminal output."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import signal
import sys
import tempfile
from collections.abc import Iterator, Mapping
from typing import IO

from bench.errors import FOLDER, INTERRUPTED, UserError, printable

MAX_CAPTURED_CHARACTERS = 300
"""Maximum number of characters of a plugin's output that are quoted."""
PROTECTED = ("bench", "builtins", "json", "math", "numpy", "os", "pandas", "scipy")
"""Packages whose functions compute or store numbers in the process of a command."""


def die_with(parent: int) -> None:
    """Make the kernel kill this process when its parent, of that id, ends (Linux)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(1, signal.SIGKILL, 0, 0, 0)  # PR_SET_PDEATHSIG
    if os.getppid() != parent:
        os._exit(1)


def exit_if_forked(pid: int) -> None:
    """Exit this process if it is a fork: its id is not ``pid``, the id of the original process."""
    if os.getpid() != pid:
        os._exit(0)


@contextlib.contextmanager
def protect_process() -> Iterator[None]:
    """Restore the working folder, the import path and the recursion limit after plugin code in the block, and exit its forks.

    What the plugin has added to the import path follows it, and it may raise the limit.

    Raises KeyboardInterrupt at the end if the plugin has swallowed one.
    """
    pid, folder, path, depth = os.getpid(), _working_folder(), [*sys.path], sys.getrecursionlimit()
    try:
        yield
    except KeyboardInterrupt:
        INTERRUPTED.clear()
        raise
    finally:
        exit_if_forked(pid)
        if folder and _working_folder() != folder:
            os.chdir(folder)
        sys.path[:] = dict.fromkeys([*path, *sys.path])
        sys.setrecursionlimit(max(depth, sys.getrecursionlimit()))
    raise_pending_interrupt()


@contextlib.contextmanager
def contained() -> Iterator[None]:
    """Run code of plugins in the block: :func:`capture_output` and :func:`protect_process`.

    Raises :class:`UserError` if it has replaced a function of a library that computes numbers of other plugins too.
    """
    before = library_functions() if any(name.startswith(FOLDER) for name in sys.modules) else {}
    with capture_output("a plugin"), protect_process():
        yield
    if before and (name := replaced(before)):
        raise UserError(
            f"a plugin has replaced {name} in the process of this command: correct the plugin, or leave it out"
        )


def library_functions() -> dict[tuple[str, str], object]:
    """Return the functions and classes of the imported :data:`PROTECTED` by names of module and attribute, and the modules."""
    found: dict[tuple[str, str], object] = {}
    for name, module in [*sys.modules.items()]:
        if name.partition(".")[0] in PROTECTED:
            found[name, ""] = module
            found |= {(name, key): one for key, one in [*getattr(module, "__dict__", {}).items()] if callable(one)}
    return found


def replaced(before: Mapping[tuple[str, str], object]) -> str:
    """Return the name of one of :func:`library_functions` that is another now; empty if all are the same."""
    now = library_functions()
    return next((".".join(filter(None, name)) for name, one in before.items() if now.get(name) is not one), "")


def raise_pending_interrupt() -> None:
    """Raise the KeyboardInterrupt that a plugin, a callback from C or a finaliser has swallowed, if any."""
    if INTERRUPTED.is_set():
        INTERRUPTED.clear()
        raise KeyboardInterrupt


def temporary_file() -> IO[bytes]:
    """Return a file without a name, to which all processes that have it open append; without a temporary folder, no file."""
    try:
        file = tempfile.TemporaryFile()  # noqa: SIM115, the caller closes it
    except OSError:
        return open(os.devnull, "w+b")
    fcntl.fcntl(file, fcntl.F_SETFL, fcntl.fcntl(file, fcntl.F_GETFL) | os.O_APPEND)
    return file


@contextlib.contextmanager
def capture_output(source: str) -> Iterator[None]:
    """Capture output printed in the block, and quote its start, without control characters, on one line of stderr.

    File descriptors are redirected instead of ``sys.stdout``, since libraries write to descriptors directly and a
    plugin may store a reference to the stream.
    """
    _flush()
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(temporary_file())
        for descriptor in (1, 2):
            with contextlib.suppress(OSError):  # the descriptor is closed
                original = os.dup(descriptor)
                stack.callback(os.close, original)
                os.dup2(file.fileno(), descriptor)
                stack.callback(os.dup2, original, descriptor)
        try:
            yield
        finally:
            _flush()
            output = os.pread(file.fileno(), 4 * MAX_CAPTURED_CHARACTERS, 0).decode(errors="replace")
    if output.strip():
        print(f"bench: {source} printed: {printable(output)[:MAX_CAPTURED_CHARACTERS]}", file=sys.stderr)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # a plugin may have closed or replaced the stream
            stream.flush()


def _working_folder() -> str:
    """Return the working folder, or an empty string if it has been removed."""
    try:
        return os.getcwd()
    except FileNotFoundError:
        return ""
