"""Hashes plugins, their parameters, and all code behind their numbers, to identify equal results.

The code includes all modules that a plugin, its base classes, the reference or a study's ``measure`` import from the
plugin's own package and from bench, except the modules in :data:`HARMLESS`.
"""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bench.engines.backend import EngineBackend
from bench.model import PolicyScene, Scene
from bench.model.parameters import Plugin, deciding, remember
from bench.model.sources import code_of, file_of, hash_of, imports_of_tree, is_below, stored_hash

HARMLESS = {
    "bench.engines.environments": "finds and installs the environments of engines, whose versions are in the row",
    "bench.engines.process": "carries arrays to an engine and back unchanged",
    "bench.errors": "statuses and the wording of messages",
    "bench.experiment": "describes cells and rows; all that it passes on to plugins is in the key",
    "bench.model.guard": "protects the process from plugins, and sees none of their numbers",
    "bench.model.isolation": "detects and undoes changes of the process",
    "bench.model.identity": "plugins as text",
    "bench.model.parameters": "declares and checks parameters, whose values are in the key",
    "bench.model.registry": "finds plugins, whose code is in the key",
    "bench.model.sources": "the hashes of code themselves",
    "bench.model.trial": "imports new plugin files in a process of their own",
    "bench.report": "shows rows",
    "bench.run.files": "writes files as they are given",
    "bench.studies.bias_variance.columns": "names, units and meanings of columns",
    "bench.studies.gradient_check.columns": "names, units and meanings of columns",
    "bench.studies.growth.columns": "names, units and meanings of columns",
    "bench.studies.three_errors.columns": "names, units and meanings of columns",
}
"""Imported modules and packages that are not hashed since they decide no number, each with the reason."""
REFERENCE = "bench.run.references"
"""The module that computes reference gradients."""
PROGRAM = "bench.model.program"
"""The module that composes scene, contact law and integrator."""
DISPLAY = ("views", "write", "show", "page", "chart", "faults", "failure")
"""Methods of a study that only show its rows."""

_fingerprints: dict[int, tuple[Plugin, str]] = {}
"""Plugins and their hashes by ``id``, since equal plugins may produce different numbers: -0.0 == 0.0, False == 0."""


def fingerprint(plugin: Plugin | None) -> str:
    """Return the hash of a plugin's kind, name, parameters and code, as JSON: floats exactly, strings in quotes.

    A parameter at its neutral value is left out, as is the declaration of one that a study has gained.
    """
    if plugin is None:
        return ""
    if id(plugin) not in _fingerprints:
        parameters = dict(sorted(deciding(plugin).items()))
        hashes = [
            plugin_hash(type(plugin)),
            *(
                [files_hash(plugin.files())]
                if isinstance(plugin, Scene | EngineBackend) and hasattr(plugin, "files")
                else []
            ),
            *([plugin_hash(type(plugin.plugin))] if isinstance(plugin, PolicyScene) else []),
        ]
        text = json.dumps([plugin.kind, plugin.name, parameters, hashes], default=repr)
        # the plugin is stored too, so that no other object gets its id
        _fingerprints[id(plugin)] = (plugin, hashlib.sha256(text.encode()).hexdigest())
    return _fingerprints[id(plugin)][1]


def hashed(*parts: Any) -> str:
    """Return a hash of JSON-like values, as 32 hexadecimal digits."""
    return hash_of_text(json.dumps(parts))


def hash_of_text(text: str) -> str:
    """Return a hash of a string, as 32 hexadecimal digits."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def code(*modules: str) -> dict[str, Path]:
    """Return the files of modules and of all their imports, by module name, except :data:`HARMLESS` modules."""
    return code_of(modules, HARMLESS)


def files_hash(files: Iterable[Path]) -> str:
    """Return the hash of a user's files and of the modules that they import from bench."""
    paths = list(files)
    scripts = [path for path in paths if path.suffix == ".py"]
    others = [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths if path.suffix != ".py"]
    modules = [name for path in scripts for name in imports_of_tree(ast.parse(path.read_bytes()), path.stem, path)]
    return "".join([hash_of([*scripts, *code(*(n for n in modules if n.startswith("bench."))).values()]), *others])


@remember
def module_hash(*modules: str) -> str:
    """Return the hash of the code of modules and of all their imports, except :data:`HARMLESS` modules."""
    return hash_of(code(*modules).values())


@remember
def plugin_hash(plugin: type[Plugin]) -> str:
    """Return the hash of the code behind a plugin: its module, the modules of its base classes, and their imports."""
    return hash_of(plugin_code(plugin).values()) + (_class_hash(plugin) if plugin.kind == "studies" else "")


def plugin_code(plugin: type[Plugin]) -> dict[str, Path]:
    """Return the files that decide a plugin's numbers, by module name; for a study, without the study's own modules."""
    modules = _defining(plugin)
    if plugin.kind != "studies":
        return code(*modules)
    return code(*(name for module in modules for name in imports_of_tree(_measuring(module), module, _file(module))))


def _defining(plugin: type[Plugin]) -> list[str]:
    """Return the modules that define a plugin's class and its base classes, without standard-library modules."""
    modules = dict.fromkeys(cls.__module__ for cls in plugin.__mro__)
    return [m for m in modules if m.partition(".")[0] not in sys.stdlib_module_names and file_of(m) is not None]


def _file(module: str) -> Path:
    path = file_of(module)
    assert path is not None
    return path


def _class_hash(study: type[Plugin]) -> str:
    """Return the hash of the modules that define a study, without what only shows rows."""
    return "".join(stored_hash(study_tree(module)) for module in _defining(study) if not is_below(module, HARMLESS))


def study_tree(module: str) -> ast.Module:
    """Return the tree of a study's module without what only shows rows, and without imports, which are hashed themselves."""
    tree = _measuring(module)
    tree.body = [
        node
        for node in tree.body
        if not isinstance(node, ast.Import | ast.ImportFrom)
        and not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test))
    ]
    return tree


def _measuring(module: str) -> ast.Module:
    """Return the syntax tree of a study's module without what :func:`_shows` names."""
    tree = ast.parse(_file(module).read_bytes())
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            node.body = [part for part in node.body if not _shows(part)] or [ast.Pass()]
    return tree


def _shows(part: ast.stmt) -> bool:
    """Return whether a part of a study's class shows rows, declares its columns, or declares a parameter it has gained.

    The value of a parameter with a neutral value is in the key wherever it can decide a number.
    """
    if isinstance(part, ast.FunctionDef):
        return part.name in DISPLAY
    targets: Iterable[ast.expr] = part.targets if isinstance(part, ast.Assign) else ()
    targets = [part.target] if isinstance(part, ast.AnnAssign) else targets
    is_gained = (
        isinstance(part, ast.AnnAssign)
        and isinstance(part.value, ast.Call)
        and any(word.arg == "neutral" for word in part.value.keywords)
    )
    return is_gained or any(isinstance(target, ast.Name) and target.id == "columns" for target in targets)
