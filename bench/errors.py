"""Errors that a user can cause, and the statuses in which a cell can end."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterable
from difflib import get_close_matches
from typing import Literal, get_args

if sys.platform == "win32":
    raise ImportError(
        "bench runs on Linux and macOS, where processes can be killed in groups; on Windows use it inside WSL"
    )

Status = Literal["ok", "nonfinite", "diverged", "timeout", "crashed", "unsupported", "unavailable", "error"]
STATUSES: tuple[str, ...] = get_args(Status)
INTERRUPTED = threading.Event()
"""Set from the moment the command is told to stop until its KeyboardInterrupt has arrived: code in between may swallow it."""


class UserError(Exception):
    """Bad input. The message says what was given, what is allowed and the nearest valid name."""


class StorageError(UserError):
    """Raised when results cannot be written or read; what was stored before stays."""


class Unsupported(Exception):
    """Raised for a combination of plugins that cannot work, with the reason; becomes a row of that status."""


def printable(text: object) -> str:
    """Return text on one line without control characters, fit for a terminal or a message.

    >>> printable("a\\nb\\x1b[31m")
    'a b [31m'
    """
    try:
        said = str(text)
    except KeyboardInterrupt:
        raise
    except BaseException:  # the message of a plugin's own kind of error is code of the plugin
        said = "(a message that cannot be printed)"
    return " ".join("".join(c if c.isprintable() else " " for c in said).split())


def unknown(what: str, given: object, allowed: Iterable[str]) -> UserError:
    """Make the error for a name that does not exist, with the nearest one that does."""
    names = sorted(allowed)
    text = str(given)
    near = get_close_matches(text.lower(), [n.lower() for n in names], n=1, cutoff=0.4)
    hint = f"; did you mean '{next(n for n in names if n.lower() == near[0])}'?" if near else ""
    return UserError(f"unknown {what} '{text}'{hint} (allowed: {', '.join(names) or 'none'})")


def failure(error: BaseException) -> dict[str, str]:
    """Return status and reason of a plugin's exception: its message and the last lines of its traceback."""
    if isinstance(error, Unsupported):
        return {"status": "unsupported", "reason": printable(error)}
    lines, step = [], error.__traceback__
    while step is not None:
        code = step.tb_frame.f_code
        lines.append(f"{os.path.basename(code.co_filename)}:{step.tb_lineno} in {code.co_name}")
        step = step.tb_next
    said = printable(error)[:1000]
    return {"status": "error", "reason": f"{type(error).__name__}: {said} ({' < '.join(reversed(lines[-3:]))})"}
