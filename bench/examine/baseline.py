"""Compares an examination with a stored baseline."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.errors import StorageError, UserError
from bench.examine.findings import Findings
from bench.report.text import number

GREW = 2.0
"""Ratio of the sizes of an error, or of numbers of calls, above which a change is reported."""


def summary(report: Findings) -> dict[str, Any]:
    """Return what a baseline stores of a report: its verdicts, the size of its error, and its calls."""
    size = report.size
    return {
        "name": report.name,
        "status": report.status,
        "derivative": report.derivative,
        "cause": report.cause,
        "size": size if math.isfinite(size) else None,
        "costs": report.spent.costs,
        "gradients": report.spent.gradients,
    }


def read_baseline(path: Path) -> dict[str, Any] | None:
    """Return a stored baseline, or None if the file does not exist. Raises :class:`UserError` for another file."""
    try:
        stored = json.loads(path.read_text())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise UserError(f"baseline={path} cannot be read: {error}. Delete it to write a new one") from None
    expected = {"status": int, "derivative": str, "cause": str, "costs": int}
    if not isinstance(stored, Mapping) or not all(isinstance(stored.get(key), kind) for key, kind in expected.items()):
        raise UserError(f"baseline={path} is not a baseline of examine: it needs {', '.join(expected)}")
    return dict(stored)


def write_baseline(path: Path, report: Findings) -> None:
    """Write the baseline of a report. Raises :class:`StorageError` if that fails."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(summary(report), indent=1) + "\n")
    except OSError as error:
        raise StorageError(f"baseline={path} cannot be written: {error}") from None


def differences(before: Mapping[str, Any], report: Findings) -> tuple[list[str], bool]:
    """Return what changed since a baseline, as sentences, and whether something is worse.

    Worse is a problem that was not there before, or the same one with an error more than twice as large.
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
    for key in ("costs", "gradients"):
        old, new = before.get(key), now[key]
        if isinstance(old, int) and max(old, new) > GREW * max(min(old, new), 1):
            changes.append(f"{key} were {old:,}, are {new:,}")
    return changes, is_worse
