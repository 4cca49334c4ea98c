"""Errors that a user can cause, and the statuses of cells."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Literal, get_args

if sys.platform == "win32":
    raise ImportError(
        "bench runs on Linux and macOS, where processes can be killed in groups; on Windows use it inside WSL"
    )

Status = Literal["ok", "nonfinite", "diverged", "timeout", "crashed", "unsupported", "unavailable", "error", "waiting"]
STATUSES: tuple[str, ...] = get_args(Status)
MAX_LISTED = 80
"""Number of characters of a list of names that is not cut."""
FOLDER = "bench_folder_"
"""Start of the name of a plugin folder's package, which :func:`printable` leaves out."""
SWEEPS = frozenset(
    [
        "PIL",
        "array_api_compat",
        "hydra",
        "matplotlib",
        "omegaconf",
        "pandas",
        "psutil",
        "pyarrow",
        "rich",
        "threadpoolctl",
        "yaml",
    ]
)
"""Packages of the extra ``sweeps``, by the names that are imported."""
INTERRUPTED = threading.Event()
"""Set while a KeyboardInterrupt is pending, since plugin code may swallow the exception before it is handled."""


class UserError(Exception):
    """Raised for invalid input. The message states the given value, the allowed values and the nearest valid name."""


class StorageError(UserError):
    """Raised when results cannot be written or read. Rows that are already stored remain valid."""


class Unsupported(Exception):
    """Raised for an incompatible combination of plugins. Its cell gets the status ``unsupported``."""


class Unavailable(Exception):
    """Raised where a library or an environment is missing. Its cell gets the status ``unavailable``."""


class Crashed(Exception):
    """Raised where a process that computes a cell's numbers has ended. Its cell gets the status ``crashed``."""


@contextmanager
def needing_sweeps(what: str) -> Iterator[None]:
    """Raise :class:`UserError` with the command where a package that ``what`` needs comes with the extra ``sweeps``."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in SWEEPS:
            raise
        raise UserError(f"{what} needs {error.name}: pip install 'diffsim-bench[sweeps]'") from None


def printable(text: object) -> str:
    """Return text on one line without control characters, for a terminal or a message.

    >>> printable("a\\nb\\x1b[31m")
    'a b [31m'
    """
    try:
        line = str(text)
    except KeyboardInterrupt:
        raise
    except BaseException:  # str() of a plugin's own exception class runs the plugin's code
        line = "(a message that cannot be printed)"
    if not line.isprintable():
        line = "".join(c if c.isprintable() else " " for c in line)
    return re.sub(rf"{FOLDER}\w{{8}}\.", "", " ".join(line.split()))


def local_path(setting: str, value: object) -> Path:
    """Return the path in a setting, with ~ expanded; raises :class:`UserError` for an address such as ``s3://results``."""
    if re.match(r"\w+:/", str(value)):
        raise UserError(f"{setting}={printable(value)} is an address, and files are written on this machine")
    return Path(str(value)).expanduser()


def unknown(what: str, given: object, allowed: Iterable[str], see: str = "") -> UserError:
    """Return the error for an unknown name, with the nearest valid name and all valid names.

    ``see`` is the command that lists all: with it, names longer than a line are cut.
    """
    names = sorted(allowed)
    text, listed = printable(given)[:100], ", ".join(names) or "none"
    lower = {name.lower(): name for name in names}
    begun = [name for name in lower if text and name.startswith(text.lower())]
    near = begun[:1] or get_close_matches(text.lower(), list(lower), n=1)
    hint = f"; did you mean '{lower[near[0]]}'?" if near else ""
    if see and len(listed) > MAX_LISTED:
        listed = f"{listed[:MAX_LISTED].rpartition(', ')[0]}, ...; all {len(names)}: python -m bench {see}"
    return UserError(f"unknown {what} '{text}'{hint} (allowed: {listed})")


def failure(error: BaseException) -> dict[str, str]:
    """Return the row fields ``status`` and ``reason`` for an exception: its message and the last 5 traceback frames."""
    for kind, status in ((Unsupported, "unsupported"), (Unavailable, "unavailable"), (Crashed, "crashed")):
        if isinstance(error, kind):
            return {"status": status, "reason": printable(error)}
    frames = traceback.extract_tb(error.__traceback__, limit=-5)
    lines = [f"{os.path.basename(frame.filename)}:{frame.lineno} in {frame.name}" for frame in reversed(frames)]
    return {"status": "error", "reason": f"{type(error).__name__}: {printable(error)[:1000]} ({' < '.join(lines)})"}


def describe_exit(code: int) -> str:
    """Describe how a process ended, from its exit code; negative codes are signals."""
    if code >= 0:
        return f"the process ended with exit status {code}"
    name = signal.Signals(-code).name
    return f"killed by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")
