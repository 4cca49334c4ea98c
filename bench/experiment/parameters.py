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
from collections.abc import Collection, Mapping
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.experiment.experiment import Budget
from bench.host.identity import identity, plain
from bench.host.parameters import parameters, singular
from bench.model import Decision, Plugin, registry

if TYPE_CHECKING:
    import pandas as pd

DESCENT = "descent"
"""The axis of the share of a descent that is done at theta0."""
THETA = "theta0"
"""The axis of the point at which gradients are taken: ``theta0``, or ``theta0.2`` for one of its coordinates."""
OWN_COLUMNS = ("horizon", "dt", "sigma", "stiffness", "noise", "dtype", "smoothing")
"""Plugin parameters with their own columns, which are therefore omitted from identity strings."""
PROBLEM = ("scene", "contact", "integrator")
"""The parts of the grid that decide the simulation, and so the gradient that estimates are compared with."""
HARNESS = {"theta": Decision, "reference": Budget}
"""Entries of a row's parameters that are dataclasses of the harness instead of plugins."""
NOT_PLUGINS = ("study", *HARNESS)
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
    records = {name: result.pop(name, None) for name in HARNESS if given}
    return result | records


@lru_cache(maxsize=1000)
def _defaults(axis: str, name: str | None, scene: str | None, folders: tuple[Path, ...]) -> dict[str, Any]:
    """Return the name and today's defaults, for JSON, of an entry of a row's parameters.

    The scene's own values of contact parameters replace the contact law's. Parameters without a default are omitted.
    """
    if axis in HARNESS:
        return {field: plain(value) for field, value in dataclasses.asdict(HARNESS[axis]()).items()}
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
    rows = rows.assign(parameters=rows["parameters"].map(completed_json))
    if "estimator_params" not in rows:
        return rows
    found = rows["parameters"].map(cache(lambda text: labels(parsed(text)).get("estimator_params")))
    return rows.assign(estimator_params=found.fillna(rows["estimator_params"]))


def identity_of(given: Mapping[str, Any], axis: str, omitted: Collection[str | None] = ()) -> str | None:
    """Return the identity string of a plugin in a row's parameters, without its defaults of today and what is ``omitted``.

    It is ``none`` where the row has no plugin, and None if the plugin is not installed, or not with all these parameters.
    """
    if not (part := given.get(axis)):
        return "none"
    plugin, scene = plugin_class(axis, part["name"]), (given.get("scene") or {}).get("name")
    if plugin is None or not part.keys() <= {"name", *parameters(plugin)}:
        return None
    defaults = _defaults(axis, plugin.name, scene, registry.folders())
    kept = {name: value for name, value in part.items() if name != "name" and name not in omitted}
    return identity(plugin.name, {k: v for k, v in kept.items() if v != defaults.get(k, dataclasses.MISSING)})


def labels(
    given: Mapping[str, Any], swept: Collection[str] = (), columns: Collection[str] = OWN_COLUMNS
) -> dict[str, str]:
    """Return identity strings by column, without ``columns`` and the parameters of ``swept`` names; none of plugins that are not installed."""
    hidden = {
        axis: {applies(name, axis, part["name"], part) for name in swept} if part else set()
        for axis, part in given.items()
        if axis not in NOT_PLUGINS
    }
    omitted = {axis: names if axis == "estimator" else {*names, *columns} for axis, names in hidden.items()}
    law = plugin_class("contact", (given.get("contact") or {}).get("name"))
    if law and "smoothing" in columns:
        omitted["contact"].add(getattr(law, "smoothing", ""))
    if law and "stiffness" in parameters(law) and "stiffness" not in hidden["scene"]:
        omitted["scene"].discard("stiffness")  # the column of that name is the law's
    found = {axis: text for axis, names in omitted.items() if (text := identity_of(given, axis, names))}
    name, _, params = found.pop("estimator", "none").partition("[")
    return found | ({"estimator": name, "estimator_params": params.removesuffix("]")} if name != "none" else {})


def applies(name: str, axis: str, plugin: str, known: Collection[str]) -> str | None:
    """Return the parameter of a plugin that a name in a sweep means, or None.

    ``known`` are the plugin's parameters. ``gamma``, ``alpha_order.gamma``, ``estimator.gamma`` and
    ``estimator.alpha_order.gamma`` name the same parameter.

    >>> applies("alpha_order.gamma", "estimator", "alpha_order", {"gamma"})
    'gamma'
    """
    *path, parameter = name.split(".")
    return parameter if parameter in known and path in ([], [plugin], [axis], [axis, plugin]) else None


# ------------------------------------------------------------------------------------------------------- flat columns


@lru_cache(maxsize=32)
def _flat(texts: tuple[str, ...], folders: tuple[Path, ...]) -> pd.DataFrame:
    """Return parameters as columns ``(part, plugin, parameter)``, a line per JSON text; missing where a text lacks one.

    Coordinates of theta are the columns of a part ``theta0``: ``theta0.1``, or ``theta0`` of a theta with only one.
    """
    import pandas as pd

    lines = []
    for given in map(parsed, texts):
        theta = given.get("theta") or {}
        at = theta.get("at") or ()
        line: dict[tuple[str, str, str], Any] = {("theta", "", DESCENT): theta.get(DESCENT, 0.0)}
        line |= {("theta", "", name): tuple(theta[name]) for name in ("names", "path") if theta.get(name)}
        line |= {(THETA, "", f"{THETA}.{i}" if len(at) > 1 else THETA): value for i, value in enumerate(at)}
        for part, entry in given.items():
            if entry and part not in HARNESS:
                values = {name: tuple(value) if isinstance(value, list) else value for name, value in entry.items()}
                line |= {(part, entry["name"], name): value for name, value in values.items()}
        lines.append(line)
    return pd.DataFrame(lines, dtype=object)


def flat_rows(rows: pd.DataFrame) -> tuple[pd.DataFrame, np.ndarray]:
    """Return the flat parameters of rows, a line per distinct JSON text, and the number of each row's line."""
    import pandas as pd

    codes, texts = pd.factorize(rows["parameters"])
    return _flat(tuple(texts), registry.folders()), codes


def _is_named(name: str, part: str, plugin: str, parameter: str) -> bool:
    """Return whether a name in a sweep refers to a flat column."""
    if part in (THETA, "theta"):
        return name == parameter or (name, parameter) == (f"{THETA}.0", THETA)
    return part not in NOT_PLUGINS and parameter != "name" and bool(applies(name, part, plugin, (parameter,)))


def named(rows: pd.DataFrame, names: Collection[str]) -> pd.DataFrame:
    """Return the columns ``(part, plugin, parameter)`` that names in a sweep refer to, with a value per row.

    ``gamma``, ``alpha_order.gamma``, ``estimator.gamma`` and ``estimator.alpha_order.gamma`` name the same parameter.
    ``theta0`` refers to the only coordinate of theta, and to nothing where theta has several.
    """
    flat, codes = flat_rows(rows)
    found = [place for name in names for place in flat if _is_named(name, *place)]
    return flat[found].iloc[codes].set_axis(rows.index)


# ------------------------------------------------------------------------------------------------------------ problems


def number_problems(rows: pd.DataFrame, parts: Collection[str] = PROBLEM, without: Collection[str] = ()) -> pd.Series:
    """Return the number of each row's problem, counted from 0 in order of appearance.

    Rows of a problem have equal parameters of the axes ``parts`` and of the study, and equal theta, except the swept
    names ``without``. A parameter that is null counts as missing.
    """
    import pandas as pd

    flat, codes = flat_rows(rows)
    # what is descended matters only where something is
    ignored = {*named(rows, without), *([("theta", "", "path")] if DESCENT in without else [])}
    own = [place for place in flat if place[0] in (*parts, "study", "theta", THETA) and place not in ignored]
    keys = [tuple(line) for line in flat[own].fillna("").to_numpy()]
    numbers: dict[tuple[Any, ...], int] = {}
    return pd.Series([numbers.setdefault(keys[code], len(numbers)) for code in codes], index=rows.index, dtype=np.int64)
