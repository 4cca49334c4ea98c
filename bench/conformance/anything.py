"""Checks of every plugin: a value with a name, documented parameters, and a way to other processes."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import pickle
import subprocess
import sys
from functools import cache

from bench import registry
from bench.conformance.kit import require, variants, verifies
from bench.conformance.subjects import (
    available,
)
from bench.contracts import (
    Plugin,
)


@verifies(Plugin)
def is_frozen_dataclass(plugin: type[Plugin]) -> str:
    """Instances are values: they can be compared, hashed and used as keys."""
    require("__dataclass_fields__" in plugin.__dict__, "is not decorated with @dataclass(frozen=True)")
    require(plugin.__dataclass_params__.frozen, "is not frozen: write @dataclass(frozen=True)")  # type: ignore[attr-defined]
    require(registry.build(plugin, {}) == registry.build(plugin, {}), "two default instances are not equal")
    return f"{hash(registry.build(plugin, {})) and len(dataclasses.fields(plugin))} parameters"


@verifies(Plugin)
def has_docstring(plugin: type[Plugin]) -> str:
    """Its own, not the one that dataclass makes up."""
    text = (plugin.__dict__.get("__doc__") or "").strip()
    require(text and not text.startswith(f"{plugin.__name__}("), "has no docstring")
    return text.splitlines()[0]


@verifies(Plugin)
def has_good_name(plugin: type[Plugin]) -> str:
    """One word for command line and tables; a built-in plugin's is that of its file."""
    name, module = plugin.name, plugin.__module__
    require(name.isidentifier() and name.islower(), f"'{name}' must be lower-case letters, digits and '_'")
    require(plugin.kind in registry.KINDS, f"kind '{plugin.kind}' is none of {', '.join(registry.KINDS)}")
    if module.startswith("plugins."):
        require(module == f"plugins.{plugin.kind}.{name}", f"'{name}' is not the name of its file, {module}")
    return module


@verifies(Plugin)
def declares_parameters(plugin: type[Plugin]) -> str:
    """Every field comes from ``param``, says what it means, and has a default that it would accept."""
    metadata = {field.name: field.metadata for field in dataclasses.fields(plugin)}
    for name, parameter in registry.parameters(plugin).items():
        require({"doc", "unit", "choices"} <= metadata[name].keys(), f"{name} is not declared with param(...)")
        require(parameter.doc, f"{name} does not say what it means")
        accepted = registry.check(parameter, parameter.default, f"{plugin.name}.{name}")
        require(accepted == parameter.default, f"{name}: the default {parameter.default!r} becomes {accepted!r}")
    return ", ".join(metadata)


@verifies(Plugin)
def survives_spawned_process(plugin: type[Plugin]) -> str:
    """Every variant, pickled into a fresh process and back, equals itself."""
    registered = tuple(p for kind in registry.KINDS for p in available(kind))
    fault = _round_trips(registered if plugin in registered else (plugin,))[plugin]
    require(not fault, fault)
    return "pickled there and back"


@cache
def _round_trips(plugins: tuple[type[Plugin], ...]) -> dict[type[Plugin], str]:
    """What went wrong on the way to one spawned process and back, empty for plugins that came back equal."""
    faults = dict.fromkeys(plugins, "")
    sent: dict[type[Plugin], bytes] = {}
    for plugin in plugins:
        try:
            sent[plugin] = pickle.dumps(list(variants(plugin).values()))
        except Exception as error:
            faults[plugin] = f"cannot be pickled: {error}"
    child = subprocess.run(
        [sys.executable, "-c", "from bench.conformance.anything import _echo; _echo()"],
        input=pickle.dumps(list(sent.values())),
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
            faults[plugin] = "comes back from a spawned process as something else"
    return faults


def _echo() -> None:
    """Run by the spawned process: unpickle each item of the list on standard input, and pickle it to standard output."""
    replies: list[bytes | str] = []
    for text in pickle.load(sys.stdin.buffer):
        try:
            with contextlib.redirect_stdout(sys.stderr):
                replies.append(pickle.dumps(pickle.loads(text)))
        except Exception as error:
            replies.append(f"{type(error).__name__}: {error}")
    sys.stdout.buffer.write(pickle.dumps(replies))
