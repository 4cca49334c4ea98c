"""Checks of every plugin: value semantics, name, documented parameters, and pickling to other processes."""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import pickle
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path

from bench.conformance.kit import Failed, require, variants, verifies
from bench.errors import printable
from bench.host.parameters import build, check, parameters
from bench.model import Plugin, registry


@verifies(Plugin)
def is_frozen_dataclass(plugin: type[Plugin]) -> str:
    """Verify that instances are values that can be compared, hashed and used as dictionary keys."""
    require("__dataclass_fields__" in plugin.__dict__, "is not decorated with @dataclass(frozen=True)")
    require(plugin.__dataclass_params__.frozen, "is not frozen: write @dataclass(frozen=True)")  # type: ignore[attr-defined]
    require(build(plugin, {}) == build(plugin, {}), "two default instances are not equal")
    return f"{hash(build(plugin, {})) and len(dataclasses.fields(plugin))} parameters"


@verifies(Plugin)
def builds(plugin: type[Plugin]) -> str:
    """Verify that an instance can be created with default parameters, and with each other choice it offers."""
    return f"{len(variants(plugin))} variants"


@verifies(Plugin)
def has_docstring(plugin: type[Plugin]) -> str:
    """Verify that the plugin has its own docstring, not the docstring that ``dataclass`` generates."""
    text = (plugin.__dict__.get("__doc__") or "").strip()
    require(text and not text.startswith(f"{plugin.__name__}("), "has no docstring")
    return text.splitlines()[0]


@verifies(Plugin)
def has_good_name(plugin: type[Plugin]) -> str:
    """Verify that the name is one word, and, for a built-in plugin, the name of its file or folder."""
    name, module = plugin.name, plugin.__module__
    require(name.isidentifier() and name.islower(), f"'{name}' must have only lower-case letters, digits and '_'")
    kinds = registry.kinds()
    require(plugin.kind in kinds, f"kind '{plugin.kind}' is not one of {', '.join(kinds)}")
    if module.startswith(f"bench.plugins.{plugin.kind}."):
        expected = f"bench.plugins.{plugin.kind}.{name}"
        require(module == expected, f"'{name}' is not the name of its file: {module}, not {expected}")
    return printable(module)


@verifies(Plugin)
def declares_parameters(plugin: type[Plugin]) -> str:
    """Verify that every field comes from ``param``, has a description, and accepts its default."""
    metadata = {field.name: field.metadata for field in dataclasses.fields(plugin)}
    for name, parameter in parameters(plugin).items():
        require({"doc", "unit", "choices"} <= metadata[name].keys(), f"{name} is not declared with param(...)")
        require(parameter.doc, f"{name} has no description")
        accepted = check(parameter, parameter.default, f"{plugin.name}.{name}")
        require(accepted == parameter.default, f"{name}: the default {parameter.default!r} becomes {accepted!r}")
    return ", ".join(metadata)


@verifies(Plugin)
def survives_spawned_process(plugin: type[Plugin]) -> str:
    """Verify that every variant equals its copy that was pickled into a spawned process and back."""
    own = list(variants(plugin).values())
    try:
        text = pickle.dumps(own)
    except Exception as error:
        raise Failed(f"cannot be pickled: {error}") from error
    try:
        reply = _spawned().submit(_echo, registry.folders(), text).result()
    except Exception as error:
        raise Failed(f"cannot be unpickled in a spawned process: {type(error).__name__}: {error}") from error
    require(pickle.loads(reply) == own, "returns from a spawned process as a different value")
    return "pickled there and back"


@cache
def _spawned() -> ProcessPoolExecutor:
    """Return the process in which plugins are unpickled; it starts at the first."""
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))


def _echo(folders: tuple[Path, ...], text: bytes) -> bytes:
    """Unpickle a text, and pickle the result; runs in the spawned process."""
    for folder in folders:
        registry.add_folder(folder)
    with contextlib.redirect_stdout(sys.stderr):
        return pickle.dumps(pickle.loads(text))
