"""Reads the swept axes of stored rows as numeric columns, and rebuilds a row's plugins from its parameters."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.experiment.experiment import Experiment
from bench.experiment.grid import COUNTS, expand, parameter_name, swept
from bench.experiment.parameters import (
    OWN_COLUMNS,
    THETA,
    flat_rows,
    labels,
    named,
    parsed,
    plugin_class,
)
from bench.host.parameters import parameters

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Axis:
    """One swept quantity: its column and unit, and its names in the sweep.

    Names that mean the same parameter of different plugins (``mass_spring.damping``, ``penalty.damping``) are one axis.
    """

    column: str
    names: tuple[str, ...]
    unit: str = ""
    doc: str = ""
    """What it is, in a few words."""
    moves: tuple[str, ...] = ()
    """Columns of the axes that step together with this axis (a zip)."""

    @property
    def short(self) -> str:
        """The parameter's own name: ``gamma`` of ``alpha_order.gamma``."""
        return parameter_name(self.column)

    @property
    def title(self) -> str:
        """The axis with its unit and the axes that step with it: ``dt [s], and with it horizon``."""
        unit = f" [{self.unit}]" if self.unit not in ("", self.column) else ""
        return f"{self.column}{unit}" + (f", and with it {', '.join(self.moves)}" if self.moves else "")


def values_of(axis: Axis, rows: pd.DataFrame) -> np.ndarray:
    """Return the numbers of an axis, one per row; NaN where it does not apply or is not a number."""
    if axis.column in COUNTS:
        return np.asarray(rows[axis.column], dtype=float)
    values = named(rows, axis.names).map(_number).assign(missing=math.nan)
    return values.bfill(axis=1).iloc[:, 0].to_numpy(float)


def _number(value: Any) -> float:
    """Return a parameter as a float; NaN if it is not a number. Infinities are stored as strings."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number or value in ("inf", "-inf") else math.nan


def smoothing_of(law: str) -> str:
    """Return the parameter that the column ``smoothing`` shows for a contact law; empty if there is none."""
    return str(getattr(plugin_class("contact", law), "smoothing", ""))


def axes(sweep: Mapping[str, Any], rows: pd.DataFrame) -> list[Axis]:
    """Return the axes of a sweep whose values are numbers, in its order.

    An axis is named after its parameter. If the column of that name means something else in some row, the axis has its
    full name: for example, scene and contact law may both have a ``stiffness``.
    """
    import pandas as pd

    coordinates = _varying_coordinates(rows) if THETA in swept(sweep) else ()
    names = [part for name in swept(sweep) for part in (coordinates if name == THETA else (name,))]
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(parameter_name(name), []).append(name)
    result = []
    for own_name, members in groups.items():
        given = [named(rows, [name]).notna().any(axis=1) for name in members]
        clash = bool((sum(given) > 1).any())
        for part in [[name] for name in members] if clash else [members]:
            column = part[0] if clash else own_name
            axis = Axis(column, tuple(part), *_declared(part, rows))
            values = values_of(axis, rows)
            is_known = np.isfinite(values)
            if not is_known.any():
                continue
            if not clash and column in rows and column not in COUNTS:
                stored = pd.to_numeric(rows.loc[is_known, column], errors="coerce")
                if not np.array_equal(stored.to_numpy(float), values[is_known]):
                    axis = replace(axis, column=part[0] if "." in part[0] else f"swept.{own_name}")
            result.append(axis)
    together = [*_zipped_names(sweep), *([frozenset(coordinates)] if len(coordinates) > 1 else [])]
    return [replace(axis, moves=_columns_in_step(axis, result, together)) for axis in result]


def _varying_coordinates(rows: pd.DataFrame) -> tuple[str, ...]:
    """Return the names of theta0's coordinates that differ between rows; ``theta0`` if it has only one."""
    flat, _ = flat_rows(rows)
    points = flat[[place for place in flat if place[0] == THETA]]
    return tuple(name for _, _, name in points if points[THETA, "", name].nunique() > 1) or (THETA,)


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


def _declared(names: Sequence[str], rows: pd.DataFrame) -> tuple[str, str]:
    """Return the unit of a parameter and its first words, as its plugins declare them; empty where they differ."""
    plugins = [(plugin_class(part, plugin), parameter) for part, plugin, parameter in named(rows, names)]
    given = [parameters(plugin)[name] for plugin, name in plugins if plugin and name in parameters(plugin)]
    units, docs = {one.unit for one in given}, {re.split("[,;:]", one.doc)[0] for one in given}
    return units.pop() if len(units) == 1 else "", docs.pop() if len(docs) == 1 else ""


def with_axes(sweep: Mapping[str, Any], rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with a numeric column added for every axis of a sweep that is not a column already."""
    return rows.assign(**{a.column: values_of(a, rows) for a in axes(sweep, rows) if a.column not in rows})


def table(experiment: Experiment, rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the columns of the CSV: the study's table, the swept axes, ``study`` and ``parameters``."""
    wide = with_axes(experiment.whole_sweep, rows)
    extra = [name for name in wide if name not in rows]
    wide = wide.reindex(columns=[*experiment.columns.table, *extra, "study", "parameters"])
    texts = [name for name in experiment.columns.of_kind("text") if name in wide]
    # an apostrophe before a formula's sign, so that a spreadsheet shows the text instead of evaluating it
    return wide.assign(**{name: wide[name].str.replace(r"^(?=\s*[=+@-])", "'", regex=True) for name in texts})


def relabel(rows: pd.DataFrame, axes: Sequence[Axis]) -> pd.DataFrame:
    """Return rows whose identity strings omit the parameters of swept axes, since these have their own columns.

    Parameters with columns of their own that do not vary between the rows of a scene and law are in the strings.
    Rows whose plugins are not installed keep their identity strings.
    """
    import pandas as pd

    names = [name for axis in axes for name in axis.names]
    columns = [name for name in OWN_COLUMNS if (rows.groupby(["scene", "contact"])[name].nunique() > 1).any()]
    codes, texts = pd.factorize(rows["parameters"])
    lines = [labels(parsed(text), names, columns) for text in texts]
    found = pd.DataFrame(lines, dtype=object).iloc[codes].set_axis(rows.index)
    return rows.assign(**{name: found[name].fillna(rows[name]) for name in found if name in rows})
