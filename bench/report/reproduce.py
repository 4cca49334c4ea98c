"""Builds the shell command that reruns the cell of a row."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping
from typing import Any

import pandas as pd

from bench.errors import UserError
from bench.experiment.axes import build_part, build_plugins
from bench.experiment.cell import Cell
from bench.experiment.experiment import Budget, Experiment
from bench.experiment.grid import COUNTS
from bench.experiment.parameters import parsed
from bench.experiment.study import Study
from bench.model import MechanicalScene, Plugin
from bench.model.identity import changed, identity

HEAD = "python -m bench name=one_cell"


def own_plugins(experiment: Experiment) -> list[str]:
    """Return the word of a command that adds the experiment's folders of plugins, shell-quoted; none without folders."""
    folders = ",".join(repr(str(folder)) for folder in experiment.plugins)
    return [shlex.quote(f"plugins=[{folders}]")] * bool(folders)


def commands(experiment: Experiment, rows: pd.DataFrame) -> list[list[str]]:
    """Return, per row, the words after :data:`HEAD` that rerun its cell, shell-quoted; empty if a plugin is missing."""
    given = rows["parameters"] if "parameters" in rows else pd.Series("", index=rows.index)
    settings = {text: _settings(parsed(text), experiment.timing) for text in given.unique()}
    head = own_plugins(experiment)
    counts = rows[list(COUNTS)].astype(int).to_dict("records")
    return [
        [*head, *settings[text], *(f"{name}={count}" for name, count in line.items())] if settings[text] else []
        for text, line in zip(given, counts, strict=True)
    ]  # fmt: skip


def _settings(given: Mapping[str, Any], timing: bool) -> list[str]:
    """Return the settings, as shell words, of an experiment with only a row's cell, without its counts; empty if a plugin is missing."""
    try:
        study, parts = build_part("study", given["study"]), build_plugins(given)
    except (UserError, KeyError):
        return []
    cell = Cell(parts, samples=0, repeats=0, seed=0, study=study)
    words = [f"study={_identity(study)}", *plugin_settings(cell), *theta_settings(given["theta"])]
    default = vars(Budget())
    budget = {name: value for name, value in (given["reference"] or {}).items() if value != default.get(name, value)}
    words += [f"reference.{name}={value!r}" for name, value in budget.items()]
    if isinstance(study, Study) and timing != study.timed:
        words.append(f"timing={str(timing).lower()}")
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
