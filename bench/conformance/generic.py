"""Checks of every plugin: value semantics, name, documented parameters, and pickling to other processes."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import pickle
import subprocess
import sys
from functools import cache

from bench.conformance.kit import require, variants, verifies
from bench.conformance.subjects import available
from bench.model import Plugin, registry
from bench.model.parameters import build, check, parameters


@verifies(Plugin)
def is_frozen_dataclass(plugin: type[Plugin]) -> str:
    """Verify that instances are values that can be compared, hashed and used as dictionary keys."""
    require("__dataclass_fields__" in plugin.__dict__, "is not decorated with @dataclass(frozen=True)")
    require(plugin.__dataclass_params__.frozen, "is not frozen: write @dataclass(frozen=True)")  # type: ignore[attr-defined]
    require(build(plugin, {}) == build(plugin, {}), "two default instances are not equal")
    return f"{hash(build(plugin, {})) and len(dataclasses.fields(plugin))} parameters"


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
    return module


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
    registered = tuple(p for kind in registry.kinds() for p in available(kind))
    fault = _round_trips(registered if plugin in registered else (plugin,))[plugin]
    require(not fault, fault)
    return "pickled there and back"


@cache
def _round_trips(plugins: tuple[type[Plugin], ...]) -> dict[type[Plugin], str]:
    """Return the fault of each plugin when pickled into a spawned process and back; empty if the copy is equal."""
    faults = dict.fromkeys(plugins, "")
    sent: dict[type[Plugin], bytes] = {}
    for plugin in plugins:
        try:
            sent[plugin] = pickle.dumps(list(variants(plugin).values()))
        except Exception as error:
            faults[plugin] = f"cannot be pickled: {error}"
    child = subprocess.run(
        [sys.executable, "-c", "from bench.conformance.generic import _echo; _echo()"],
        input=pickle.dumps((registry.folders(), list(sent.values()))),
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
    )
    if child.returncode:
        raise RuntimeError(child.stderr.decode(errors="replace").strip().rpartition("\n")[2])
    replies = pickle.loads(child.stdout)
    for plugin, reply in zip(sent, replies, strict=True):
        if isinstance(reply, str):
            faults[plugin] = f"cannot be unpickled in a spawned process: {reply}"
        elif pickle.loads(reply) != list(variants(plugin).values()):
            faults[plugin] = "returns from a spawned process as a different value"
    return faults


def _echo() -> None:
    """Unpickle each item of the list on standard input, and pickle it to standard output; runs in the spawned process."""
    folders, texts = pickle.load(sys.stdin.buffer)
    for folder in folders:
        registry.add_folder(folder)
    replies: list[bytes | str] = []
    for text in texts:
        try:
            with contextlib.redirect_stdout(sys.stderr):
                replies.append(pickle.dumps(pickle.loads(text)))
        except Exception as error:
            replies.append(f"{type(error).__name__}: {error}")
    sys.stdout.buffer.write(pickle.dumps(replies))
