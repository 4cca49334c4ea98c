"""Builds the shell command that reruns the cell of a row."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Collection, Mapping
from typing import Any

import pandas as pd

from bench.errors import UserError
from bench.experiment.axes import build_part
from bench.experiment.cell import Cell
from bench.experiment.experiment import Budget, Experiment
from bench.experiment.grid import COUNTS
from bench.experiment.parameters import NOT_PLUGINS, parsed
from bench.experiment.study import Study
from bench.model import Decision, MechanicalScene, Plugin
from bench.model.identity import changed, identity
from bench.model.program import OWN

HEAD = "python -m bench name=one_cell"


def own_plugins(experiment: Experiment) -> list[str]:
    """Return the word of a command that adds the experiment's folders of plugins, shell-quoted; none without folders."""
    folders = ",".join(repr(str(folder)) for folder in experiment.plugins)
    return [shlex.quote(f"plugins=[{folders}]")] * bool(folders)


def commands(experiment: Experiment, rows: pd.DataFrame) -> list[list[str]]:
    """Return, per row, the words after :data:`HEAD` that rerun its cell, shell-quoted; empty if a plugin is missing."""
    known: dict[str, Plugin] = {}
    given = rows["parameters"] if "parameters" in rows else pd.Series("", index=rows.index)
    settings = {text: _settings(parsed(text), known, experiment.timing) for text in given.unique()}
    head = own_plugins(experiment)
    counts = rows[list(COUNTS)].astype(int).to_dict("records")
    return [
        [*head, *settings[text], *(f"{name}={count}" for name, count in line.items())] if settings[text] else []
        for text, line in zip(given, counts, strict=True)
    ]  # fmt: skip


def cell_of(given: Mapping[str, Any], known: dict[str, Plugin]) -> Cell:
    """Return a cell of a row's parameters, with counts of 0; raises :class:`UserError` if a plugin is not installed.

    ``known`` are the plugins built so far, which cells share.
    """
    parts: dict[str, Plugin | None] = {}
    for axis, part in given.items():
        text = json.dumps([axis, part])
        if part is not None and text not in known and axis not in ("theta", "reference"):
            known[text] = build_part(axis, part)
        parts[axis] = known.get(text)
    study, theta, budget = parts["study"], given["theta"], given["reference"]
    assert study is not None
    return Cell(
        {axis: plugin for axis, plugin in parts.items() if axis not in NOT_PLUGINS},
        samples=0,
        repeats=0,
        seed=0,
        study=study,
        decision=Decision(tuple(theta["names"]), theta["at"] and tuple(theta["at"])) if theta else OWN,
        budget=Budget(**budget) if budget else None,
    )


def _settings(given: Mapping[str, Any], known: dict[str, Plugin], timing: bool) -> list[str]:
    """Return the settings, as shell words, of an experiment with only a row's cell, without its counts; empty if a plugin is missing."""
    try:
        cell = dataclasses.replace(cell_of(given, known), timing=timing)
    except (UserError, KeyError):
        return []
    words = [f"study={_identity(cell.study)}", *plugin_settings(cell), *theta_settings(given["theta"])]
    default = Budget()
    for name in ("samples", "points", "tolerance") if cell.budget is not None else ():
        if getattr(cell.budget, name) != getattr(default, name):
            words.append(f"reference.{name}={getattr(cell.budget, name)!r}")
    if isinstance(cell.study, Study) and cell.timing != cell.study.timed:
        words.append(f"timing={str(cell.timing).lower()}")
    return [*map(shlex.quote, words)]


def plugin_settings(cell: Cell, without: Collection[str] = ()) -> list[str]:
    """Return a setting for the plugin on each axis, ``contacts=[penalty[stiffness=100]]``, except axes ``without``.

    Parameters at their defaults are omitted. The scene's contact values count as defaults of its contact law.
    """
    given = dict(cell.scene.contact_values) if isinstance(cell.scene, MechanicalScene) else {}
    return [
        f"{part.kind}=[{_identity(part, given if axis == 'contact' else {})}]"
        for axis, part in cell.parts.items()
        if part is not None and axis not in without
    ]


def theta_settings(theta: Mapping[str, Any] | None) -> list[str]:
    """Return the settings of a row's theta: its names, and the point of the gradients; empty if they are the scene's own."""
    theta = theta or {}
    lists = {"theta": theta.get("names"), "theta0": theta.get("at"), "path": theta.get("path")}
    words = [f"{name}=[{','.join(map(str, items))}]" for name, items in lists.items() if items]
    return words + [f"descent={theta.get('descent')}"] * bool(theta.get("descent"))


def check_of(cell: Cell) -> str:
    """Return a shell command that repeats a cell's gradient checks: ``gradcheck SCENE``, and non-default settings.

    The cell's horizon replaces the default sweep of ``gradcheck``. Counts and estimator are omitted: no check depends
    on them.
    """
    scene, line = _identity(cell.scene), []
    if isinstance(cell.scene, MechanicalScene):
        scene, line = _identity(cell.scene, {"horizon": cell.scene.horizon}), [f"sweep.horizon=[{cell.scene.horizon}]"]
    study = [f"study={_identity(cell.study)}"] * bool(changed(cell.study))
    theta = theta_settings(cell.parameters["theta"])
    line += [*plugin_settings(cell, without=("scene", "estimator")), f"seed={cell.seed}", *theta, *study]
    return shlex.join(["python", "-m", "bench", "gradcheck", scene, *line])


def _identity(plugin: Plugin, given: Mapping[str, Any] | None = None) -> str:
    return identity(plugin.name, changed(plugin, given))
