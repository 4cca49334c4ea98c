"""Builds the shell command that reruns the cell of a row."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping
from typing import Any

import pandas as pd

from bench.experiment.cell import Cell
from bench.experiment.experiment import Budget, Experiment
from bench.experiment.grid import COUNTS
from bench.experiment.parameters import NOT_PLUGINS, identity_of, parsed, plugin_class
from bench.model import MechanicalScene, registry

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
    ]


def _settings(given: Mapping[str, Any], timing: bool) -> list[str]:
    """Return the settings, as shell words, of an experiment with only a row's cell, without its counts; empty if a plugin is missing."""
    study, plugins = identity_of(given, "study"), plugin_settings(given)
    if not given or study is None or plugins is None:
        return []
    words = [f"study={study}", *plugins, *theta_settings(given["theta"])]
    default = vars(Budget())
    budget = {name: value for name, value in (given["reference"] or {}).items() if value != default.get(name, value)}
    words += [f"reference.{name}={value!r}" for name, value in budget.items()]
    if timing != getattr(plugin_class("study", given["study"]["name"]), "timed", timing):
        words.append(f"timing={str(timing).lower()}")
    return [*map(shlex.quote, words)]


def plugin_settings(given: Mapping[str, Any], without: Collection[str] = ()) -> list[str] | None:
    """Return a setting for the plugin on each axis, ``contacts=[penalty[stiffness=100]]``, except axes ``without``; None if one is missing."""
    axes = [axis for axis, part in given.items() if part and axis not in (*NOT_PLUGINS, *without)]
    found = [identity_of(given, axis) for axis in axes]
    return None if None in found else [f"{registry.kind_of(a)}=[{text}]" for a, text in zip(axes, found, strict=True)]


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
    given, line = cell.parameters, []
    if isinstance(cell.scene, MechanicalScene):
        line.append(f"sweep.horizon=[{cell.scene.horizon}]")
    line += [
        *(plugin_settings(given, ("scene", "estimator")) or ()),
        f"seed={cell.seed}",
        *theta_settings(given["theta"]),
    ]
    study = identity_of(given, "study") or ""
    line += [f"study={study}"] * ("[" in study)
    return shlex.join(["python", "-m", "bench", "gradcheck", str(identity_of(given, "scene", ("horizon",))), *line])
