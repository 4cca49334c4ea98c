"""Decides when two results are the same: hashes of plugins, of the core's own code, and of what a study measures."""

from __future__ import annotations

import hashlib
import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bench import measure, model
from bench.model.parameters import Plugin, remember, values
from bench.model.sources import hash_of, source_hash, sources

CORE = {
    model: (
        "backend",
        "callables",
        "contact",
        "dynamics",
        "estimator",
        "integrator",
        "ops",
        "problem",
        "program",
        "scene",
    ),
    measure: ("batches", "jumps", "noise", "quadrature", "reference", "smoothed", "statistics"),
}
"""Modules that decide numbers in every study."""
BOOKKEEPING = ("bench.errors", "bench.model", "bench.experiment", "bench.run", "bench.report")
"""What a study imports without effect on its numbers, or what :data:`CORE` has already."""

_fingerprints: dict[int, tuple[Plugin, str]] = {}
"""Hashes by identity of the plugin, since equal plugins may differ in their numbers: -0.0 equals 0.0, and False 0."""


def fingerprint(plugin: Plugin | None) -> str:
    """Return the hash of a plugin's kind, name, parameters and code, as JSON: floats exactly, strings in quotes."""
    if plugin is None:
        return ""
    if id(plugin) not in _fingerprints:
        text = json.dumps([plugin.kind, plugin.name, dict(sorted(values(plugin).items())), _code(plugin)], default=repr)
        # the plugin is kept alive, so that its id is not given to another object
        _fingerprints[id(plugin)] = (plugin, hashlib.sha256(text.encode()).hexdigest())
    return _fingerprints[id(plugin)][1]


def _code(plugin: Plugin) -> str:
    if isinstance(plugin, model.CallableScene):
        return source_hash(type(plugin)) + hash_of(plugin.files())
    return study_hash(type(plugin)) if plugin.kind == "studies" else source_hash(type(plugin))


def hashed(*parts: Any) -> str:
    """Return a short hash of JSON-like values."""
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


@remember
def core_hash() -> str:
    """Return the hash of the harness's own code that decides numbers in every study."""
    return hash_of(
        Path(str(package.__file__)).with_name(f"{name}.py") for package, names in CORE.items() for name in names
    )


@remember
def study_hash(study: type[Plugin]) -> str:
    """Return the hash of the measuring code: the study's module ``measure`` (or its own) and what that imports."""
    module = f"{study.__module__}.measure"
    try:
        beside = find_spec(module) is not None
    except ModuleNotFoundError:
        beside = False
    return hash_of(sources(module if beside else study.__module__, BOOKKEEPING))
