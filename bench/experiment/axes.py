"""What a stored row says about its cell: its plugins, and the swept axes as numbers, all from its own parameters."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from bench.errors import UserError
from bench.experiment.cell import labels
from bench.experiment.experiment import Experiment
from bench.experiment.grid import COUNTS, THETA, applies, expand, is_theta_axis, parameter_name, swept
from bench.model import Plugin, registry
from bench.model.parameters import Parameter, build, parameters

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd

NOT_PARTS = ("study", "theta", "reference")
"""Entries of a row's parameters that are not a plugin on an axis."""


@dataclass(frozen=True)
class Axis:
    """One swept quantity: the column that holds it, what it means, and which names in the sweep it gathers.

    Names that mean the same parameter of different plugins (``mass_spring.damping``, ``penalty.damping``) are one axis.
    """

    column: str
    names: tuple[str, ...]
    unit: str = ""
    doc: str = ""
    moves: tuple[str, ...] = ()
    """Columns of other axes that step together with this one (a zip)."""

    @property
    def short(self) -> str:
        """The parameter's own name: ``gamma`` of ``alpha_order.gamma``."""
        return parameter_name(self.column)

    @property
    def title(self) -> str:
        """The axis with its unit and what moves with it: ``dt [s], with horizon``."""
        unit = f" [{self.unit}]" if self.unit else ""
        return f"{self.column}{unit}" + (f", with {', '.join(self.moves)}" if self.moves else "")


def parsed(rows: pd.DataFrame) -> list[Mapping[str, Any]]:
    """Return the parameters of each row; empty where a row has none."""
    return [_parsed(text) for text in rows["parameters"]] if "parameters" in rows else [{} for _ in range(len(rows))]


@lru_cache(maxsize=20_000)
def _parsed(text: str) -> Mapping[str, Any]:
    given: Mapping[str, Any] = json.loads(text) if text else {}
    return given


def value_of(name: str, given: Mapping[str, Any]) -> Any:
    """Return the value that a row's parameters give to a name in a sweep; None if it applies to none of its plugins."""
    if is_theta_axis(name):
        return _coordinate(name, (given.get("theta") or {}).get("at") or ())
    for group, part in given.items():
        if _is_part(group, part):
            parameter = applies(name, registry.kind_of(group), part["name"], part)
            if parameter is not None and parameter != "name":
                return part[parameter]
    return None


def _coordinate(name: str, at: Sequence[float]) -> float | None:
    """Return a coordinate of theta0; of ``theta0`` itself the only one, None where it has several."""
    _, dot, coordinate = name.partition(".")
    if not dot:
        return at[0] if len(at) == 1 else None
    return at[int(coordinate)] if int(coordinate) < len(at) else None


def values_of(axis: Axis, rows: pd.DataFrame) -> np.ndarray:
    """Return the numbers of an axis, NaN where it does not apply or is not a number."""
    import numpy as np

    if axis.column in COUNTS:
        return rows[axis.column].to_numpy(float)
    cache: dict[int, float] = {}

    def number(given: Mapping[str, Any]) -> float:
        if id(given) not in cache:
            values = (value_of(name, given) for name in axis.names)
            cache[id(given)] = next((_number(value) for value in values if value is not None), np.nan)
        return cache[id(given)]

    return np.array([number(given) for given in parsed(rows)], dtype=float)


def shown_by(view: str, axis: Axis, rows: pd.DataFrame) -> np.ndarray:
    """Return, per row, whether ``stiffness`` or ``smoothing`` is this very axis: a parameter of its contact law."""
    import numpy as np

    cache: dict[int, bool] = {}

    def shown(given: Mapping[str, Any]) -> bool:
        part = given.get("contact")
        if part is None:
            return False
        entry = registry.entries()["contacts"].get(part["name"])
        parameter = view if view != "smoothing" else getattr(entry and entry.plugin, "smoothing", "")
        return bool(parameter) and any(
            applies(name, "contacts", part["name"], part) == parameter for name in axis.names
        )

    return np.array(
        [cache[id(g)] if id(g) in cache else cache.setdefault(id(g), shown(g)) for g in parsed(rows)], dtype=bool
    )


def _number(value: Any) -> float:
    if isinstance(value, str):
        return float(value) if value in ("inf", "-inf") else float("nan")
    return float("nan") if isinstance(value, bool) else float(value)


def axes(sweep: Mapping[str, Any], rows: pd.DataFrame) -> list[Axis]:
    """Return the axes of a sweep whose values are numbers, in its order.

    An axis takes the name of its parameter, unless that column means something else in some row, as when scene and
    contact law both have a ``stiffness``: then the axis keeps its full name.
    """
    import numpy as np

    given = list({id(one): one for one in parsed(rows)}.values())
    coordinates = _moved(given) if THETA in swept(sweep) else ()
    names = [part for name in swept(sweep) for part in (coordinates if name == THETA else (name,))]
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(parameter_name(name), []).append(name)
    result = []
    for own_name, members in groups.items():
        clash = any(sum(value_of(name, one) is not None for name in members) > 1 for one in given)
        for part in [[name] for name in members] if clash else [members]:
            column = part[0] if clash else own_name
            axis = Axis(column, tuple(part), *_meaning(part, given))
            values = values_of(axis, rows)
            own = np.isfinite(values)
            if not own.any():
                continue
            if not clash and column in rows and column not in COUNTS:
                shown = np.asarray(rows[column], dtype=float)
                if not np.array_equal(shown[own], values[own]):
                    axis = Axis(part[0] if "." in part[0] else f"swept.{own_name}", axis.names, axis.unit, axis.doc)
            result.append(axis)
    together = [*_together(sweep), *([frozenset(coordinates)] if len(coordinates) > 1 else [])]
    return [Axis(axis.column, axis.names, axis.unit, axis.doc, _moving(axis, result, together)) for axis in result]


def _moved(given: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the names of theta0's coordinates that differ between rows; ``theta0`` where it has but one."""
    thetas = [tuple(at) for one in given if (at := (one.get("theta") or {}).get("at"))]
    longest = max(map(len, thetas), default=1)
    if longest == 1:
        return (THETA,)
    return tuple(f"{THETA}.{i}" for i in range(longest) if len({at[i] for at in thetas if i < len(at)}) > 1)


def _moving(axis: Axis, found: Sequence[Axis], together: Sequence[frozenset[str]]) -> tuple[str, ...]:
    partners = {name for group in together for name in group if group & set(axis.names)} - set(axis.names)
    return tuple(other.column for other in found if other is not axis and partners & set(other.names))


def _together(sweep: Mapping[str, Any]) -> list[frozenset[str]]:
    """Return the groups of names that step together in a ``zip``, wherever it stands in the sweep."""
    groups = []
    for name, value in sweep.items():
        if name == "zip":
            groups.append(frozenset(expand({"zip": value})[0]))
        elif name == "product":
            groups += _together(value)
        elif name == "union":
            groups += [group for part in value for group in _together(part)]
    return groups


def _meaning(names: Iterable[str], given: Sequence[Mapping[str, Any]]) -> tuple[str, str]:
    """Return unit and meaning of a parameter, as its plugin declares them."""
    plugins = {(group, part["name"]): None for one in given for group, part in one.items() if _is_part(group, part)}
    meanings = {}
    for name in names:
        for group, plugin in plugins:
            kind = registry.kind_of(group)
            declared = declared_parameters(kind, plugin)
            if (parameter := applies(name, kind, plugin, declared)) is not None:
                meanings[declared[parameter].unit] = declared[parameter].doc
    # a unit that differs between scenes cannot stand on a common axis
    return next(iter(meanings.items())) if len(meanings) == 1 else ("", "")


def _is_part(group: str, part: Any) -> bool:
    return group not in NOT_PARTS and part is not None


def declared_parameters(kind: str, name: str) -> Mapping[str, Parameter]:
    """Return the parameters that a plugin declares; none where it is not installed here."""
    entry = registry.entries().get(kind, {}).get(name)
    return parameters(entry.plugin) if entry is not None and entry.plugin is not None else {}


def with_axes(experiment: Experiment, rows: pd.DataFrame) -> pd.DataFrame:
    """Add to rows a numeric column for every swept axis that is not a column already."""
    return rows.assign(**{a.column: values_of(a, rows) for a in axes(experiment.sweep, rows) if a.column not in rows})


def table(experiment: Experiment, rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows as the CSV has them: the study's table, the swept axes, then the cell's whole identity."""
    extra = [axis.column for axis in axes(experiment.sweep, rows) if axis.column not in rows]
    wide = with_axes(experiment, rows)
    wide = wide.reindex(columns=[*experiment.columns.table, *extra, "study", "parameters"])
    texts = [name for name in experiment.columns.of_kind("text") if name in wide]
    return wide.assign(**{name: wide[name].map(_harmless) for name in texts})


def _harmless(text: Any) -> Any:
    """Return a string that a spreadsheet shows and does not calculate: with an apostrophe before a formula's sign."""
    return f"'{text}" if isinstance(text, str) and text[:1] in ("=", "+", "-", "@") else text


def revived(given: Mapping[str, Any]) -> dict[str, Plugin | None]:
    """Build the plugins described by a row's parameters, by axis; raises :class:`UserError` if one is not installed."""
    parts: dict[str, Plugin | None] = {}
    for axis, part in given.items():
        if axis in NOT_PARTS:
            continue
        values = {} if part is None else {name: value for name, value in part.items() if name != "name"}
        parts[axis] = None if part is None else build(registry.usable(registry.kind_of(axis), part["name"]), values)
    return parts


def relabelled(rows: pd.DataFrame, axes: Sequence[Axis]) -> pd.DataFrame:
    """Drop from rows' identity strings the parameters shown as columns of swept axes; unknown plugins keep theirs."""
    names = [name for axis in axes for name in axis.names]
    known: dict[str, dict[str, str]] = {}

    def read(some: Mapping[str, Any]) -> dict[str, str]:
        text = repr(some)
        if text not in known:
            known[text] = _labels(some, names)
        return known[text]

    lines = []
    for given in parsed(rows):
        estimator = {group: part for group, part in given.items() if group == "estimator"}
        problem = {group: part for group, part in given.items() if group != "estimator"}
        lines.append(read(problem) | read(estimator))
    changed = {name for line in lines for name in line}
    return rows.assign(
        **{name: [line.get(name, old) for line, old in zip(lines, rows[name], strict=True)] for name in changed}
    )


def _labels(given: Mapping[str, Any], names: Sequence[str]) -> dict[str, str]:
    hidden: dict[str, set[str]] = {}
    for group, part in given.items():
        if _is_part(group, part):
            taken = {applies(name, registry.kind_of(group), part["name"], part) for name in names}
            hidden[group] = {parameter for parameter in taken if parameter is not None}
    if not any(hidden.values()):
        return {}
    try:
        return labels(revived(given), hidden)
    except UserError:
        return {}
