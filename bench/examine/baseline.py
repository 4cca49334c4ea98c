"""Compares an examination with a stored baseline."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.errors import UserError
from bench.examine.findings import Findings
from bench.report.text import number
from bench.run.files import make_directory, write_whole

GREW = 1.05
"""Ratio of the sizes of an error above which a change is reported: rounding on another machine changes less."""


def summary(report: Findings) -> dict[str, Any]:
    """Return what a baseline stores of a report: its verdicts and the size of its error."""
    size = report.size
    return {
        "name": report.name,
        "status": report.status,
        "derivative": report.derivative,
        "cause": report.cause,
        "size": size if math.isfinite(size) else None,
    }


def read_baseline(path: Path) -> dict[str, Any] | None:
    """Return a stored baseline, or None if the file does not exist. Raises :class:`UserError` for another file."""
    try:
        stored = json.loads(path.read_text())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise UserError(f"baseline={path} cannot be read: {error}. Delete it to write a new one") from None
    expected = {"status": int, "derivative": str, "cause": str}
    if not isinstance(stored, Mapping) or not all(isinstance(stored.get(key), kind) for key, kind in expected.items()):
        raise UserError(f"baseline={path} is not a baseline of examine: it needs {', '.join(expected)}")
    return dict(stored)


def write_baseline(path: Path, report: Findings) -> None:
    """Write the baseline of a report. Raises :class:`bench.StorageError` if that fails."""
    make_directory(path.parent)
    write_whole(path, f"{json.dumps(summary(report), indent=1)}\n".encode())


def differences(before: Mapping[str, Any], report: Findings) -> tuple[list[str], bool]:
    """Return what changed since a baseline, as sentences, and whether something is worse.

    Worse is a problem that was not there before, or the same one with an error more than 5% larger.
    """
    now = summary(report)
    changes = [
        f"{key} was {before[key]}, is {now[key]}" for key in ("derivative", "cause") if before.get(key) != now[key]
    ]
    is_worse = bool(now["status"] and (before["status"] == 0 or before["cause"] != now["cause"]))
    old, new = before.get("size"), now["size"]
    if isinstance(old, int | float) and new is not None and max(old, new) > 1e-6:
        if new > GREW * old or old > GREW * new:
            changes.append(f"the error was {number(100 * old)}%, is {number(100 * new)}%")
        is_worse |= bool(now["status"] and new > GREW * old)
    return changes, is_worse
