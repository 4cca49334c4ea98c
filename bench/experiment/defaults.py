"""Adds missing parameters to stored rows, so that rows remain usable when a plugin gains a parameter with a default.

A stored row contains every parameter of its plugins and of its study as JSON. If a plugin has gained a parameter since,
the row counts as computed with that parameter's present default. All code that compares, groups or shows rows by their
parameters reads them through :func:`completed`, :func:`completed_json` or :func:`completed_rows`: ``compare``, ``plan``,
``report``, ``index`` and :func:`bench.load`.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.experiment.experiment import Budget
from bench.model import Decision, Plugin, registry
from bench.model.identity import plain
from bench.model.parameters import parameters, singular

if TYPE_CHECKING:
    import pandas as pd

RECORDS = {"theta": Decision, "reference": Budget}
"""Entries of a row's parameters that are dataclasses of the harness instead of plugins."""


def completed(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row's parameters with today's defaults where a plugin, the study, theta or the reference lacks one.

    Parameters are in the order in which they are declared today, followed by parameters that are no longer declared. The
    parameters of a plugin that is not installed are unchanged. The result is empty if ``given`` is.
    """
    if not given:
        return {}
    result = {axis: _with_defaults(part, defaults_of(axis, given)) for axis, part in given.items()}
    records = {name: result.pop(name, None) for name in RECORDS}
    return result | records


def completed_json(text: str) -> str:
    """Return :func:`completed` parameters as JSON in the format of new rows; other strings are returned unchanged."""
    return _completed_json(text, registry.folders())


@lru_cache(maxsize=50_000)
def _completed_json(text: str, folders: tuple[Path, ...]) -> str:
    """Return completed JSON, cached by ``text`` and plugin ``folders``, since an added folder may define a plugin."""
    try:
        given = json.loads(text)
    except (TypeError, ValueError):
        return text
    if not isinstance(given, dict) or not given:
        return text
    return json.dumps(completed(given), separators=(",", ":"))


def completed_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the column ``parameters`` completed, so that rows stored before and after a change agree."""
    texts = {text: completed_json(text) for text in rows["parameters"].unique()}
    if all(text is new or text == new for text, new in texts.items()):
        return rows
    return rows.assign(parameters=rows["parameters"].map(texts))


def defaults_of(axis: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return today's defaults, as JSON-like values, of the entry ``axis`` of a row's parameters.

    The scene's own values of contact parameters take precedence over the contact law's. Parameters without a default
    are omitted. The result is empty if the entry is empty or its plugin is not installed.
    """
    part = given.get(axis)
    if not isinstance(part, Mapping):
        return {}
    if axis in RECORDS:
        return {name: plain(value) for name, value in dataclasses.asdict(RECORDS[axis]()).items()}
    plugin = _plugin_class(axis, part)
    if plugin is None:
        return {}
    values = {
        name: parameter.default
        for name, parameter in parameters(plugin).items()
        if parameter.default is not dataclasses.MISSING
    }
    if axis == "contact":
        of_scene = getattr(_plugin_class("scene", given.get("scene")), "contact_values", {})
        values |= {name: value for name, value in of_scene.items() if name in values}
    return {name: plain(value) for name, value in values.items()}


def _plugin_class(axis: str, part: Any) -> type[Plugin] | None:
    kind = next((kind for kind in registry.kinds() if singular(kind) == axis), "")
    name = part.get("name") if isinstance(part, Mapping) else None
    entry = registry.entries().get(kind, {}).get(str(name))
    return entry.plugin if entry is not None else None


def _with_defaults(part: Any, defaults: Mapping[str, Any]) -> Any:
    """Return an entry with its name first, then declared parameters in their order, then all others."""
    if not isinstance(part, Mapping):
        return part
    first = {"name": part["name"]} if "name" in part else {}
    return (
        first
        | {name: part.get(name, value) for name, value in defaults.items()}
        | {name: value for name, value in part.items() if name not in first and name not in defaults}
    )
