"""The command that runs one cell again, by itself."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

import pandas as pd

from bench.contracts import MechanicalScene, Plugin
from bench.errors import UserError
from bench.grid import Cell, Experiment, cells, changed
from bench.registry import identity
from bench.store import IDENTITY

HEAD = "python -m bench name=one_cell"


def words(cell: Cell, experiment: Experiment) -> list[str]:
    """What follows :data:`HEAD`, quoted for a shell; the cell has the same key under it and so the same numbers."""
    given = dict(cell.scene.contact_values) if isinstance(cell.scene, MechanicalScene) else {}
    parts = [f"study={cell.study}"]
    for part in cell.parts:
        if part is not None:
            parts.append(f"{part.kind}=[{_identity(part, given if part is cell.contact else {})}]")
    parts += [f"{name}={getattr(cell, name)}" for name in ("samples", "repeats", "seed")]
    for name in ("samples", "tolerance"):
        value = getattr(experiment, f"reference_{name}")
        if value != getattr(Experiment, f"reference_{name}"):
            parts.append(f"reference.{name}={value}")
    return [shlex.quote(part) for part in parts]


def _identity(plugin: Plugin, given: Mapping[str, Any]) -> str:
    return identity(plugin.name, changed(plugin, given))


def commands(experiment: Experiment, rows: pd.DataFrame) -> list[list[str]]:
    """Of each row the words that run its cell; none where the experiment, as it is configured now, has no such cell."""
    try:
        known = cells(experiment)
    except UserError:
        return [[] for _ in range(len(rows))]
    by_key = {cell.key: cell for cell in known}
    by_identity: dict[tuple[str, ...], Cell] = {}
    if not set(rows["key"]) <= set(by_key):
        by_identity = {_named(cell.columns()): cell for cell in known}
    found = []
    for row in rows[["key", *IDENTITY]].to_dict("records"):
        cell = by_key.get(row["key"]) or by_identity.get(_named(row))
        found.append([] if cell is None else words(cell, experiment))
    return found


def _named(columns: Mapping[Any, Any]) -> tuple[str, ...]:
    return tuple(value if isinstance(value, str) else f"{value:g}" for value in (columns[name] for name in IDENTITY))
