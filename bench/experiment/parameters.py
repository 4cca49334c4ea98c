"""Reads the JSON of stored rows' parameters: plugins with today's defaults, swept quantities, and problems.

A stored row contains every parameter of its plugins and of its study. If a plugin has gained a parameter since, the row
counts as computed with that parameter's present default: all code that compares, groups or shows rows by their parameters
reads them through :func:`completed`, :func:`parsed` or :func:`completed_rows`. Each distinct JSON text is read once.

Errors and costs may be compared between rows of one **problem**: rows with the same parameters of some parts of the grid
(by default :data:`PROBLEM`) and of the study, and the same theta, see :func:`number_problems`.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.experiment.experiment import Budget
from bench.experiment.grid import DESCENT, THETA, applies, is_theta_axis
from bench.model import Decision, Plugin, registry
from bench.model.identity import identity, plain
from bench.model.parameters import parameters, singular

if TYPE_CHECKING:
    import pandas as pd

PROBLEM = ("scene", "contact", "integrator")
"""The parts of the grid that decide the simulation, and so the gradient that estimates are compared with."""
RECORDS = {"theta": Decision, "reference": Budget}
"""Entries of a row's parameters that are dataclasses of the harness instead of plugins."""
NOT_PLUGINS = ("study", *RECORDS)
"""Entries of a row's parameters that are not plugins on an axis of the grid."""


# ---------------------------------------------------------------------------------------------------------- defaults


def completed(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row's parameters with today's defaults where a plugin, the study, theta or the reference lacks one.

    Parameters are in the order in which they are declared today, followed by parameters that are no longer declared. The
    parameters of a plugin that is not installed are unchanged. The result is empty if ``given`` is.
    """
    scene = (given.get("scene") or {}).get("name")
    result = {
        axis: part and _defaults(axis, part.get("name"), scene, registry.folders()) | part
        for axis, part in given.items()
    }
    records = {name: result.pop(name, None) for name in RECORDS if given}
    return result | records


@lru_cache(maxsize=1000)
def _defaults(axis: str, name: str | None, scene: str | None, folders: tuple[Path, ...]) -> dict[str, Any]:
    """Return the name and today's defaults, for JSON, of an entry of a row's parameters.

    The scene's own values of contact parameters replace the contact law's. Parameters without a default are omitted.
    """
    if axis in RECORDS:
        return {field: plain(value) for field, value in dataclasses.asdict(RECORDS[axis]()).items()}
    plugin = plugin_class(axis, name)
    declared = parameters(plugin) if plugin else {}
    values = {key: one.default for key, one in declared.items() if one.default is not dataclasses.MISSING}
    if axis == "contact":
        of_scene = getattr(plugin_class("scene", scene), "contact_values", {})
        values |= {key: value for key, value in of_scene.items() if key in values}
    return {"name": name} | {key: plain(value) for key, value in values.items()}


def plugin_class(axis: str, name: str | None) -> type[Plugin] | None:
    """Return the class of the plugin ``name`` on an axis such as ``scene``; None if it is not installed."""
    kind = next((kind for kind in registry.kinds() if singular(kind) == axis), "")
    entry = registry.entries().get(kind, {}).get(str(name))
    return entry.plugin if entry is not None else None


def parsed(text: str) -> Mapping[str, Any]:
    """Return :func:`completed` parameters from the JSON of a row; empty if the row stores none."""
    return _read(text, registry.folders())[0]


def completed_json(text: str) -> str:
    """Return :func:`completed` parameters as JSON in the format of new rows; an empty string is returned unchanged."""
    return _read(text, registry.folders())[1]


@lru_cache(maxsize=20_000)
def _read(text: str, folders: tuple[Path, ...]) -> tuple[Mapping[str, Any], str]:
    """Return completed parameters and their JSON, cached by plugin ``folders`` too: an added folder may define a plugin."""
    if not text:
        return {}, text
    given = completed(json.loads(text))
    return given, json.dumps(given, separators=(",", ":"))


def completed_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the column ``parameters`` completed, so that rows stored before and after a change agree.

    The column ``estimator_params``, if there is one, has the parameters that differ from today's defaults.
    """
    texts = {text: completed_json(text) for text in rows["parameters"].unique()}
    rows = (
        rows
        if all(text == new for text, new in texts.items())
        else rows.assign(parameters=rows["parameters"].map(texts))
    )
    if "estimator_params" not in rows:
        return rows
    labels = rows["parameters"].map({text: estimator_params(parsed(text)) for text in texts.values()})
    return rows.assign(estimator_params=labels.fillna(rows["estimator_params"]))


def estimator_params(given: Mapping[str, Any]) -> str | None:
    """Return the parameters of a row's estimator that differ from today's defaults; None if it is not installed."""
    part = given.get("estimator") or {}
    if plugin_class("estimator", part.get("name")) is None:
        return None
    defaults = _defaults("estimator", part["name"], None, registry.folders())
    return identity("", {name: value for name, value in part.items() if value != defaults.get(name, value)}).strip("[]")


# --------------------------------------------------------------------------------------------------- swept quantities


class Place(NamedTuple):
    """A swept quantity of a row: the part of the grid, its plugin and parameter, and the value."""

    part: str
    plugin: str
    parameter: str
    value: Any

    @property
    def number(self) -> float:
        """The value as a float; NaN if it is not a number. Infinities are stored as strings."""
        is_number = isinstance(self.value, int | float) and not isinstance(self.value, bool)
        return float(self.value) if is_number or self.value in ("inf", "-inf") else math.nan


def places(names: Collection[str], given: Mapping[str, Any]) -> list[Place]:
    """Return what names in a sweep refer to in a row's parameters.

    ``gamma``, ``alpha_order.gamma``, ``estimator.gamma`` and ``estimator.alpha_order.gamma`` name the same parameter.
    ``theta0`` refers to the only coordinate of theta, and to nothing where theta has several.
    """
    result = []
    for name in names:
        if name == DESCENT:
            result.append(Place("theta", "", name, (given.get("theta") or {}).get(name, 0.0)))
            continue
        if is_theta_axis(name):
            at = (given.get("theta") or {}).get("at") or ()
            index = int(name.partition(".")[2] or 0)
            if index < len(at) and (name != THETA or len(at) == 1):
                result.append(Place(THETA, "", name, at[index]))
            continue
        parameter = name.rpartition(".")[2]
        for part, entry in given.items():
            is_plugin = entry and part not in NOT_PLUGINS
            if is_plugin and parameter in entry and parameter != "name" and applies(name, part, entry["name"], entry):
                result.append(Place(part, entry["name"], parameter, entry[parameter]))
    return result


def of_places(rows: pd.DataFrame, names: Collection[str], value: Callable[[Sequence[Place]], Any]) -> np.ndarray:
    """Return a value per row, computed from the places that names in a sweep refer to."""
    import pandas as pd

    codes, texts = pd.factorize(rows["parameters"])
    values = [value(found) for found in _places(tuple(names), tuple(texts), registry.folders())]
    return np.array(values)[codes] if values else np.empty(0)


@lru_cache(maxsize=32)
def _places(names: tuple[str, ...], texts: tuple[str, ...], folders: tuple[Path, ...]) -> list[list[Place]]:
    return [places(names, parsed(text)) for text in texts]


# ------------------------------------------------------------------------------------------------------------ problems


def number_problems(rows: pd.DataFrame, parts: Collection[str] = PROBLEM, without: Collection[str] = ()) -> pd.Series:
    """Return the number of each row's problem, counted from 0 in order of appearance.

    Rows of a problem have equal parameters of the axes ``parts`` and of the study, and equal theta, except the swept
    names ``without``.
    """
    import pandas as pd

    codes, texts = pd.factorize(rows["parameters"])
    numbers = _numbers(tuple(texts), tuple(parts), tuple(without), registry.folders())
    return pd.Series(numbers[codes], index=rows.index)


@lru_cache(maxsize=16)
def _numbers(
    texts: tuple[str, ...], parts: tuple[str, ...], without: tuple[str, ...], folders: tuple[Path, ...]
) -> np.ndarray:
    problems: dict[frozenset[Any], int] = {}
    numbers = [problems.setdefault(_problem(parsed(text), parts, without), len(problems)) for text in texts]
    return np.array(numbers, dtype=np.int64)


def _problem(given: Mapping[str, Any], parts: Collection[str], without: Collection[str]) -> frozenset[Any]:
    """Return what identifies the problem of a row's parameters: they count as missing if they are null."""
    ignored = {(place.part, place.parameter) for place in places(without, given)}
    if DESCENT in without:  # what is descended matters only where something is
        ignored.add(("theta", "path"))
    found = []
    for part in (*parts, "study", "theta"):
        for name, value in (given.get(part) or {}).items():
            if (part, name) == ("theta", "at"):
                found += [((THETA, f"{THETA}.{i}"), coordinate) for i, coordinate in enumerate(value or ())]
            elif value is not None and (value or part != "theta"):
                found.append(((part, name), tuple(value) if isinstance(value, list) else value))
    return frozenset(item for item in found if item[0] not in ignored)
