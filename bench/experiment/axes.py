"""Reads the swept axes of stored rows as numeric columns, and rebuilds a row's plugins from its parameters."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

from bench.errors import UserError
from bench.experiment.cell import VIEWS, labels
from bench.experiment.experiment import Experiment
from bench.experiment.grid import COUNTS, THETA, applies, expand, is_theta_axis, parameter_name, swept
from bench.experiment.parameters import NOT_PLUGINS, as_number, flatten, parse, swept_columns
from bench.model import Plugin, registry
from bench.model.parameters import build, parameters

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd


@dataclass(frozen=True)
class Axis:
    """One swept quantity: its column, unit and meaning, and its names in the sweep.

    Names that mean the same parameter of different plugins (``mass_spring.damping``, ``penalty.damping``) are one axis.
    """

    column: str
    names: tuple[str, ...]
    unit: str = ""
    doc: str = ""
    moves: tuple[str, ...] = ()
    """Columns of the axes that step together with this axis (a zip)."""

    @property
    def short(self) -> str:
        """The parameter's own name: ``gamma`` of ``alpha_order.gamma``."""
        return parameter_name(self.column)

    @property
    def title(self) -> str:
        """The axis with its unit and the axes that step with it: ``dt [s], with horizon``."""
        unit = f" [{self.unit}]" if self.unit not in ("", self.column) else ""
        return f"{self.column}{unit}" + (f", with {', '.join(self.moves)}" if self.moves else "")


def values_of(axis: Axis, rows: pd.DataFrame) -> np.ndarray:
    """Return the numbers of an axis, one per row; NaN where it does not apply or is not a number."""
    import numpy as np
    import pandas as pd

    if axis.column in COUNTS:
        return np.asarray(rows[axis.column], dtype=float)
    table = flatten(rows)
    values = pd.Series(np.nan, index=range(len(rows)))
    for column, mask in _places(axis.names, table):
        numbers = table[column].map(as_number) if table[column].dtype == object else table[column]
        values = values.fillna(numbers.where(mask).reset_index(drop=True))
    return np.asarray(values, dtype=float)


def shown_by(view: str, axis: Axis, rows: pd.DataFrame) -> np.ndarray:
    """Return, per row, whether the column ``view`` (``stiffness`` or ``smoothing``) shows the axis for its contact law."""
    import numpy as np

    table = flatten(rows)
    shown = np.zeros(len(rows), dtype=bool)
    for column, mask in _places(axis.names, table):
        group, _, parameter = column.partition(".")
        if group == "contact":
            laws = table["contact.name"]
            names = laws.map(smoothing_of, na_action="ignore") if view == "smoothing" else view
            shown |= (mask & laws.notna() & (names == parameter)).to_numpy(bool)
    return shown


def _places(names: Iterable[str], table: pd.DataFrame) -> Iterator[tuple[str, pd.Series]]:
    """Yield the columns of flattened parameters that names in a sweep refer to, each with a mask of its rows."""
    for name in names:
        yield from swept_columns(name, table).items()


def smoothing_of(law: str) -> str:
    """Return the parameter that the column ``smoothing`` shows for a contact law; empty if there is none."""
    entry = registry.entries()["contacts"].get(law)
    return str(getattr(entry and entry.plugin, "smoothing", ""))


def axes(sweep: Mapping[str, Any], rows: pd.DataFrame) -> list[Axis]:
    """Return the axes of a sweep whose values are numbers, in its order.

    An axis is named after its parameter. If the column of that name means something else in some row, the axis has its
    full name: for example, scene and contact law may both have a ``stiffness``.
    """
    import numpy as np
    import pandas as pd

    table = flatten(rows).drop_duplicates()
    coordinates = _varying_coordinates(table) if THETA in swept(sweep) else ()
    names = [part for name in swept(sweep) for part in (coordinates if name == THETA else (name,))]
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(parameter_name(name), []).append(name)
    result = []
    for own_name, members in groups.items():
        clash = bool((np.sum([_has_value(name, table) for name in members], axis=0) > 1).any())
        for part in [[name] for name in members] if clash else [members]:
            column = part[0] if clash else own_name
            axis = Axis(column, tuple(part), *_unit_and_doc(part, table))
            values = values_of(axis, rows)
            is_known = np.isfinite(values)
            if not is_known.any():
                continue
            if not clash and column in rows and column not in COUNTS:
                is_number = pd.api.types.is_numeric_dtype(rows[column])
                if not is_number or not np.array_equal(rows.loc[is_known, column].to_numpy(float), values[is_known]):
                    axis = replace(axis, column=part[0] if "." in part[0] else f"swept.{own_name}")
            result.append(axis)
    together = [*_zipped_names(sweep), *([frozenset(coordinates)] if len(coordinates) > 1 else [])]
    return [replace(axis, moves=_columns_in_step(axis, result, together)) for axis in result]


def _has_value(name: str, table: pd.DataFrame) -> np.ndarray:
    """Return, per row of flattened parameters, 1 where a name in the sweep has a value and 0 elsewhere."""
    import numpy as np

    values = [mask & table[column].notna() for column, mask in _places([name], table)]
    return np.any(values, axis=0).astype(int) if values else np.zeros(len(table), dtype=int)


def _varying_coordinates(table: pd.DataFrame) -> tuple[str, ...]:
    """Return the names of theta0's coordinates that differ between rows; ``theta0`` if it has only one."""
    coordinates = [column for column in table if is_theta_axis(column)]
    if len(coordinates) < 2:
        return (THETA,)
    return tuple(column for column in coordinates if table[column].nunique() > 1)


def _columns_in_step(axis: Axis, others: Sequence[Axis], together: Sequence[frozenset[str]]) -> tuple[str, ...]:
    """Return the columns of the axes that step together with an axis."""
    partners = {name for group in together for name in group if group & set(axis.names)} - set(axis.names)
    return tuple(other.column for other in others if other is not axis and partners & set(other.names))


def _zipped_names(sweep: Mapping[str, Any]) -> list[frozenset[str]]:
    """Return, for each ``zip`` at any depth of the sweep, the names that step together."""
    groups = []
    for name, value in sweep.items():
        if name == "zip":
            groups.append(frozenset(expand({"zip": value})[0]))
        elif name == "product":
            groups += _zipped_names(value)
        elif name == "union":
            groups += [group for part in value for group in _zipped_names(part)]
    return groups


def _unit_and_doc(names: Iterable[str], table: pd.DataFrame) -> tuple[str, str]:
    """Return unit and meaning of a parameter, as its plugins declare them; empty strings if their units differ."""
    meanings = {}
    for column, mask in _places(names, table):
        axis, _, parameter = column.partition(".")
        for plugin in table.loc[mask, f"{axis}.name"].unique() if f"{axis}.name" in table else ():
            entry = registry.entries().get(registry.kind_of(axis), {}).get(plugin)
            declared = parameters(entry.plugin).get(parameter) if entry and entry.plugin else None
            if declared is not None:
                meanings[declared.unit] = declared.doc
    return next(iter(meanings.items())) if len(meanings) == 1 else ("", "")


def with_axes(sweep: Mapping[str, Any], rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with a numeric column added for every axis of a sweep that is not a column already."""
    return rows.assign(**{a.column: values_of(a, rows) for a in axes(sweep, rows) if a.column not in rows})


def table(experiment: Experiment, rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the columns of the CSV: the study's table, the swept axes, ``study`` and ``parameters``."""
    wide = with_axes(experiment.sweep, rows)
    extra = [name for name in wide if name not in rows]
    wide = wide.reindex(columns=[*experiment.columns.table, *extra, "study", "parameters"])
    texts = [name for name in experiment.columns.of_kind("text") if name in wide]
    escaped = {name: {text: _escape_formula(text) for text in wide[name].unique()} for name in texts}
    # a column without formulas keeps its strings, of which equal ones are one object
    changed = [name for name in texts if any(new is not old for old, new in escaped[name].items())]
    return wide.assign(**{name: wide[name].map(escaped[name]) for name in changed})


def _escape_formula(text: Any) -> Any:
    """Return text with an apostrophe before a formula's sign, so that a spreadsheet shows it instead of evaluating it."""
    return f"'{text}" if isinstance(text, str) and text.lstrip()[:1] in ("=", "+", "-", "@") else text


def build_plugins(given: Mapping[str, Any]) -> dict[str, Plugin | None]:
    """Build the plugins described by a row's parameters, by axis; raises :class:`UserError` if one is not installed."""
    return {a: None if p is None else build_part(a, p) for a, p in given.items() if a not in NOT_PLUGINS}


def build_part(axis: str, part: Mapping[str, Any]) -> Plugin:
    """Return the plugin of one axis from its name and parameters; raises :class:`UserError` if it is not installed."""
    return build(registry.usable(registry.kind_of(axis), part["name"]), {k: v for k, v in part.items() if k != "name"})


def relabel(rows: pd.DataFrame, axes: Sequence[Axis]) -> pd.DataFrame:
    """Return rows whose identity strings omit the parameters of swept axes, since these have their own columns.

    Parameters with columns of their own that do not vary between the rows of a scene and law are in the strings.
    Rows whose plugins are not installed keep their identity strings.
    """
    import pandas as pd

    names = [name for axis in axes for name in axis.names]
    views = [name for name in VIEWS if (rows.groupby(["scene", "contact"])[name].nunique() > 1).any()]
    read = cache(lambda text: _labels(json.loads(text), names, views))
    codes, distinct = pd.factorize(rows["parameters"])
    lines = []
    for given in parse(pd.DataFrame({"parameters": distinct})):
        estimator = {axis: part for axis, part in given.items() if axis == "estimator"}
        problem = {axis: part for axis, part in given.items() if axis != "estimator"}
        lines.append(read(json.dumps(problem)) | read(json.dumps(estimator)))
    found = pd.DataFrame(lines, dtype=object).iloc[codes].set_axis(rows.index)
    return rows.assign(**{name: found[name].fillna(rows[name]) for name in found if name in rows})


def _labels(given: Mapping[str, Any], names: Sequence[str], views: Sequence[str]) -> dict[str, str]:
    hidden = {
        axis: {parameter for name in names if (parameter := applies(name, axis, part["name"], part))}
        for axis, part in given.items()
        if axis not in NOT_PLUGINS and part is not None
    }
    if "estimator" in given and not hidden.get("estimator"):
        return {}
    try:
        return labels(build_plugins(given), hidden, views)
    except UserError:
        return {}
