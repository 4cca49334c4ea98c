"""Stores descents beside the reference gradients."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.host import reads
from bench.measure.descent import DescentPath
from bench.model import registry
from bench.run.files import make_directory, write_whole
from bench.run.rows import read_object


def save(folder: Path, key: str, found: Mapping[str, Any], read: str = "") -> DescentPath:
    """Store the fields of a descent, and what code from outside has read for it, and return it."""
    make_directory(folder)
    write_whole(_path(folder, key), json.dumps({**found, "reads": read}).encode())
    return DescentPath(**found)


def load(folder: Path, key: str) -> DescentPath | None:
    """Return a stored descent; None if the file is missing or unreadable, or something that it has read has changed."""
    found = read_object(_path(folder, key))
    if reads.Present(registry.environment()).change(found.pop("reads", "")):
        return None
    try:
        return DescentPath(**found)
    except TypeError:
        return None


def _path(folder: Path, key: str) -> Path:
    return folder / f"descent_{key}.json"
