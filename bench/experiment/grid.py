"""Expands an experiment's axes into cells."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from bench.errors import Unsupported, UserError, unknown
from bench.experiment.cell import DESCENDED, Cell
from bench.experiment.experiment import Choice, Experiment
from bench.experiment.parameters import DESCENT, PROBLEM, THETA, applies
from bench.host.parameters import build, coerce, parameters, singular
from bench.model import ContactLaw, Decision, MechanicalScene, Plugin, compose
from bench.model.program import OWN

MAX_CELLS = 1_000_000
"""Largest number of cells in a sweep; planning that many takes minutes."""
COUNTS = ("samples", "repeats", "seed")
"""Settings that a sweep can vary besides plugin parameters and :data:`THETA`."""


def is_theta_axis(axis: str) -> bool:
    """Return whether an axis is theta0 or one of its coordinates.

    >>> [is_theta_axis(axis) for axis in ("theta0", "theta0.2", "heaviside.theta", "theta0.x")]
    [True, True, False, False]
    """
    name, dot, coordinate = axis.partition(".")
    return name == THETA and (not dot or coordinate.isdecimal())


def parameter_name(axis: str) -> str:
    """Return the parameter that an axis names: ``gamma`` for ``alpha_order.gamma``, ``theta0.2`` for ``theta0.2``."""
    return axis if is_theta_axis(axis) else axis.rpartition(".")[2]


def cells(experiment: Experiment) -> list[Cell]:
    """Return the cells of an experiment and of those that join it, each once, in sweep order; raises :class:`UserError` for invalid values."""
    refuse_too_many(experiment.sweep, math.prod(len(some) for some in experiment.choices.values()))
    check_axes(
        swept(experiment.sweep),
        [c.entry.plugin for some in experiment.choices.values() for c in some if c.entry.plugin],
    )
    unique: dict[str, Cell] = {}
    for point in expand(experiment.sweep):
        for choices in itertools.product(*experiment.choices.values()):
            cell = _cell(experiment, point, dict(zip(experiment.choices, choices, strict=True)))
            unique.setdefault(cell.key, cell)
    for cell in (cell for other in experiment.also for cell in cells(other)):
        unique.setdefault(cell.key, cell)
    if not unique:
        raise UserError("the experiment has no cells: choose at least one of each of scenes, backends, estimators")
    if any(cell.decision != OWN for cell in unique.values()):
        _check_theta(list(unique.values()))
    return list(unique.values())


def _check_theta(cells: Sequence[Cell]) -> None:
    """Raise the first error of theta if it is valid in no cell. Otherwise the rows report the error."""
    first: UserError | None = None
    for cell in cells:
        try:
            cell.program()
        except UserError as error:
            first = first or error
        except Unsupported:
            continue
        else:
            return
    if first is not None:
        raise first


def refuse_too_many(sweep: Mapping[str, Any], cells_per_point: int = 1) -> None:
    """Raise :class:`UserError` for a sweep of more than :data:`MAX_CELLS` cells."""
    size = math.prod(map(len, _factors(sweep))) * cells_per_point
    if size > MAX_CELLS:
        raise UserError(
            f"the sweep has {size} cells, and more than {MAX_CELLS} are not allowed: give it fewer values, or split it"
        )


def expand(sweep: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Expand a sweep into points: named axes are multiplied, ``zip`` pairs its axes, ``union`` concatenates sweeps.

    >>> expand({"a": [1, 2], "b": [3]})
    [{'a': 1, 'b': 3}, {'a': 2, 'b': 3}]
    >>> expand({"zip": {"c": [4, 5], "d": [6, 7]}})
    [{'c': 4, 'd': 6}, {'c': 5, 'd': 7}]
    >>> expand({"union": [{"a": [1]}, {"b": [2]}]})
    [{'a': 1}, {'b': 2}]
    """
    return [_join(combo) for combo in itertools.product(*_factors(sweep))]


def _factors(sweep: Mapping[str, Any]) -> list[list[dict[str, Any]]]:
    """Return the lists of points whose product is the sweep."""
    factors: list[list[dict[str, Any]]] = []
    for axis, value in sweep.items():
        if axis == "product":
            factors += _factors(_mapping(value, "sweep.product"))
        elif axis == "zip":
            columns = _zipped(value)
            factors.append([dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)])
        elif axis == "union":
            if not isinstance(value, list | tuple):
                raise UserError("sweep.union must be a list of sweeps")
            parts = [_mapping(part, "sweep.union") for part in value]
            for part in parts:
                refuse_too_many(part)
            factors.append([point for part in parts for point in expand(part)])
        else:
            factors.extend([{name: v} for v in _values(name, vs)] for name, vs in _flat({axis: value}).items())
    return factors


def _zipped(value: Any) -> dict[str, list[Any]]:
    """Return the values of the axes in a ``zip``; raises :class:`UserError` unless they are equally long."""
    columns = {name: _values(name, v) for name, v in _flat(_mapping(value, "sweep.zip")).items()}
    lengths = {name: len(v) for name, v in columns.items()}
    if len(set(lengths.values())) > 1:
        raise UserError(f"zipped axes must be equally long, given {lengths}")
    return columns


def _join(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return one point with the axes of all parts; raises :class:`UserError` if two parts have the same axis."""
    point = dict(itertools.chain(*(part.items() for part in parts)))
    if len(point) < sum(map(len, parts)):
        name = next(name for name in point if sum(name in part for part in parts) > 1)
        raise UserError(f"sweep axis '{name}' is given twice: once on its own and once in a zip, union or product")
    return point


def swept(sweep: Mapping[str, Any]) -> list[str]:
    """Return the names of the axes of a sweep, in order; raises :class:`UserError` as :func:`expand` does.

    >>> swept({"a": [1, 2], "union": [{"b": [1]}, {"zip": {"a": [1], "c": [2]}}]})
    ['a', 'b', 'c']
    """
    return list(dict.fromkeys(name for factor in _factors(sweep) for point in factor for name in point))


def _mapping(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise UserError(f"{where} must map axes to lists of values, given {value!r}")
    return value


def _flat(sweep: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in sweep.items():
        path = f"{prefix}{name}"
        flat.update(_flat(value, path + ".") if isinstance(value, Mapping) else {path: value})
    return flat


def _values(axis: str, values: Any) -> list[Any]:
    listed = list(values) if isinstance(values, list | tuple) else [values]
    if not listed:
        raise UserError(f"sweep.{axis} is empty: give at least one value")
    return listed


def coerce_finite(values: Any, name: str) -> tuple[float, ...]:
    """Return one number or a list as finite floats; raises :class:`UserError` otherwise."""
    numbers = tuple(coerce(float, value, name) for value in (values if isinstance(values, list | tuple) else [values]))
    if not all(map(math.isfinite, numbers)):
        raise UserError(f"{name}={list(numbers)} must be finite")
    if "." in name and len(numbers) != 1:
        raise UserError(f"{name} takes one number at a time, given {list(numbers)}")
    return numbers


def share_of(value: Any) -> float:
    """Return a value of the setting ``descent``; raises :class:`UserError` unless it is at least 0 and below 1."""
    share = coerce(float, value, DESCENT)
    if not 0.0 <= share < 1.0:
        raise UserError(f"{DESCENT}={share:g} must be at least 0 and below 1: the share of a descent that is done")
    return float(share)


def _applies(name: str, plugin: type[Plugin]) -> str | None:
    return applies(name, singular(plugin.kind), plugin.name, parameters(plugin))


def check_axes(axes: Sequence[str], plugins: Sequence[type[Plugin]]) -> None:
    """Raise :class:`UserError` for an axis that is a parameter of none of the plugins, nor a count or theta."""
    names = {name for plugin in plugins for name in parameters(plugin)} | {*COUNTS, DESCENT, THETA}
    for axis in axes:
        if (
            axis not in (*COUNTS, DESCENT)
            and not is_theta_axis(axis)
            and not any(_applies(axis, plugin) for plugin in plugins)
        ):
            raise unknown("sweep axis", axis, names)


def _cell(experiment: Experiment, point: Mapping[str, Any], choices: Mapping[str, Choice]) -> Cell:
    """Return the cell of these choices at a point of the sweep."""
    used: dict[str, str] = {}
    parts: dict[str, Plugin | None] = {}
    for axis, choice in choices.items():
        is_used = _uses(parts.get("scene"), axis)
        parts[axis] = _plugin(experiment, axis, choice, point, used, parts.get("scene")) if is_used else None
    decision = start = _decision(experiment, point, parts)
    if share := share_of(point.get(DESCENT, experiment.descent)):
        decision = dataclasses.replace(start, descent=share)
    parts = experiment.study.parts(parts)
    return Cell(
        parts,
        **_counts(experiment, point),
        study=experiment.study,
        decision=decision,
        timing=experiment.timing,
        budget=experiment.reference if experiment.study.compares(parts) else None,
        path=_path(experiment, parts["scene"], start) if share else None,
        swept=tuple(parameter_name(axis) for axis in used if parts["scene"] and used[axis] == parts["scene"].name),
    )


def _path(experiment: Experiment, scene: Plugin | None, start: Decision) -> Cell:
    """Return the cell at the start of a descent; its contact law has the scene's own values, and none of the sweep's."""
    parts: dict[str, Plugin | None] = {"scene": scene}
    for axis in DESCENDED:
        choice = experiment.path.get(axis)
        parts[axis] = None
        if choice is not None and choice.entry.plugin is not None and _uses(scene, axis):
            values = _of_scene(scene, choice.entry.plugin) | dict(choice.values)
            parts[axis] = _build(choice.entry.plugin, sorted(values.items()))
    return Cell(parts, samples=0, repeats=0, seed=0, study=experiment.study, decision=start)


def _decision(experiment: Experiment, point: Mapping[str, Any], parts: Mapping[str, Plugin | None]) -> Decision:
    """Return theta at a point of the sweep; coordinates that are not swept keep their values."""
    decision = experiment.decision
    given = {name: coerce_finite(values, name) for name, values in point.items() if is_theta_axis(name)}
    if not given:
        return decision
    if THETA in given:
        if len(given) > 1:
            raise UserError(f"the sweep gives theta0 and {', '.join(given.keys() - {THETA})}: give one of them")
        return dataclasses.replace(decision, at=given[THETA])
    try:
        program: list[Any] = [*map(parts.get, PROBLEM), experiment.study.decision(decision)]
        at = compose(*program).theta0.tolist()
    except (Unsupported, UserError):  # the cell reports the error in its row
        return decision
    for name, values in given.items():
        coordinate = int(name.partition(".")[2])
        if coordinate >= len(at):
            raise UserError(f"sweep axis '{name}': theta has {len(at)} coordinates, counted from 0")
        (at[coordinate],) = values
    return dataclasses.replace(decision, at=tuple(at))


def _counts(experiment: Experiment, point: Mapping[str, Any]) -> dict[str, Any]:
    counts: dict[str, int] = {}
    for name, low in zip(COUNTS, (1, 2, 0), strict=True):
        counts[name] = coerce(int, point.get(name, getattr(experiment, name)), name)
        if counts[name] < low:
            raise UserError(f"{name}={counts[name]} must be at least {low}")
    return counts


def _plugin(
    experiment: Experiment,
    axis: str,
    choice: Choice,
    point: Mapping[str, Any],
    used: dict[str, str],
    scene: Plugin | None,
) -> Plugin:
    plugin = choice.entry.plugin
    if plugin is None:
        raise UserError(f"{axis} '{choice.entry.name}' cannot be used: {choice.entry.reason}")
    axes = _axes_of(plugin, tuple(point))
    for name, parameter in axes:
        if name in used:
            raise UserError(
                f"sweep axis '{name}' is a parameter of both {used[name]} and {plugin.name}: "
                f"write sweep.{used[name]}.{parameter} or sweep.{plugin.name}.{parameter}"
            )
        if parameter in dict(choice.values):
            raise UserError(f"{choice} gives {parameter}, which the sweep varies: leave one of them out")
        used[name] = plugin.name
    # later values replace earlier ones: the scene's contact values, settings, identity string, sweep
    values = dict(_of_scene(scene, plugin), **experiment.values.get(axis, {}).get(plugin.name, {}))
    values |= dict(choice.values) | {parameter: point[name] for name, parameter in axes}
    return _build(plugin, sorted(values.items()))


def _of_scene(scene: Plugin | None, plugin: type[Plugin]) -> dict[str, Any]:
    """Return the scene's own values of the parameters of its contact law; empty for another plugin."""
    given = getattr(scene, "contact_values", {}) if issubclass(plugin, ContactLaw) else {}
    return {name: value for name, value in given.items() if name in parameters(plugin)}


def _uses(scene: Plugin | None, axis: str) -> bool:
    """Return whether a scene has the parts of an axis: integrators step motion, and contact laws act on contacts."""
    if axis not in ("integrator", "contact"):
        return True
    return isinstance(scene, MechanicalScene) and (axis == "integrator" or scene.n_contacts != 0)


@cache
def _axes_of(plugin: type[Plugin], names: tuple[str, ...]) -> list[tuple[str, str]]:
    """Return the axes that are parameters of the plugin, each with the parameter's name."""
    pairs = [(name, _applies(name, plugin)) for name in names if name not in COUNTS]
    return [(axis, parameter) for axis, parameter in pairs if parameter is not None]


_built: dict[tuple[type[Plugin], str], Plugin] = {}


def _build(plugin: type[Plugin], values: Sequence[tuple[str, Any]]) -> Plugin:
    """Return the plugin with these values, built once. 1, 1.0 and True differ: a parameter may accept only one."""
    key = (plugin, repr(values))
    if key not in _built:
        _built[key] = build(plugin, dict(values))
    return _built[key]
