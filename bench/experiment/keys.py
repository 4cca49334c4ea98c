"""Identifies equal results: by all parameters, by declared revisions, and by files from outside the package.

A plugin class of the package, and a module that decides numbers, declares its revision, which is raised when a stored
number moves. Plugins and simulators from elsewhere count by the content of their files and of what these import from
their own folders.
"""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

from bench.host import reads
from bench.host.parameters import Plugin, parameters, remember, values
from bench.measure import noise, statistics
from bench.model import PolicyScene, Scene, program

SHARED = (noise, program)
"""Modules that decide the numbers of all cells."""
COMPARED = (statistics,)
"""Modules that decide the numbers of cells that are compared with a reference."""

HASHED: dict[str, str] = {}
"""The hashes of files in keys, by path."""
_fingerprints: dict[int, tuple[Plugin, str]] = {}
"""Plugins and their hashes by ``id``, since equal plugins may produce different numbers: -0.0 == 0.0, False == 0."""


def fingerprint(plugin: Plugin | None) -> str:
    """Return the hash of a plugin's kind, name, parameters and code, as JSON: floats exactly, strings in quotes."""
    if plugin is None:
        return ""
    if id(plugin) not in _fingerprints:
        code = [code_of(type(plugin))]
        if isinstance(plugin, PolicyScene):
            code.append(code_of(type(plugin.plugin)))
        if names_files(plugin):
            reads.start()
            code.append(files_hash(map(Path, getattr(plugin, "files")())))  # noqa: B009, not part of the contract
        text = json.dumps([plugin.kind, plugin.name, counted(plugin), code], default=repr)
        # the plugin is stored too, so that no other object gets its id
        _fingerprints[id(plugin)] = (plugin, hashlib.sha256(text.encode()).hexdigest())
    return _fingerprints[id(plugin)][1]


def names_files(plugin: Plugin) -> bool:
    """Return whether a plugin names files from outside that it reads."""
    return hasattr(plugin, "files") and (isinstance(plugin, Scene) or not _is_own(type(plugin).__module__))


def counted(plugin: Plugin) -> dict[str, Any]:
    """Return the parameters that identify a plugin: all but those that it gained later and that have their defaults."""
    declared = parameters(type(plugin))
    given = sorted(values(plugin).items())
    return {name: value for name, value in given if not (declared[name].added and value == declared[name].default)}


def hashed(*parts: Any) -> str:
    """Return a hash of JSON-like values, as 32 hexadecimal digits."""
    return hash_of_text(json.dumps(parts))


def hash_of_text(text: str) -> str:
    """Return a hash of a string, as 32 hexadecimal digits."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@remember
def code_of(plugin: type[Plugin]) -> str:
    """Return what identifies the code of a plugin class and its bases: raised revisions, and a hash of other files."""
    revisions: dict[str, int] = {}
    files = []
    for owner in plugin.__mro__:
        if _is_own(owner.__module__):
            revisions[owner.__qualname__] = vars(owner).get("revision", 1)
            revisions |= revisions_of(vars(owner).get("uses", ()))
        elif owner.__module__.partition(".")[0] not in sys.stdlib_module_names:
            module = sys.modules.get(owner.__module__)
            if revision := getattr(module, "REVISION", 0):
                revisions[owner.__qualname__] = revision
            else:
                files.append(getattr(module, "__file__", None))
    return json.dumps([raised(revisions), files_hash(Path(file) for file in files if file)])


def raised(revisions: Mapping[str, int]) -> dict[str, int]:
    """Return the revisions above the first: a class or module that is new, moved or renamed changes no key."""
    return {name: revision for name, revision in sorted(revisions.items()) if revision != 1}


def revisions_of(modules: Iterable[ModuleType]) -> dict[str, int]:
    """Return the ``REVISION`` of each module."""
    return {module.__name__: module.REVISION for module in modules}


def _is_own(module: str) -> bool:
    return module.partition(".")[0] == "bench"


def files_hash(files: Iterable[Path]) -> str:
    """Return the hash of files and of what they import from their own folders; empty without files."""
    waiting, hashes = list(files), {}
    while waiting:
        path = waiting.pop().resolve()
        if path not in hashes:
            content = path.read_bytes()
            hashes[path] = hashlib.sha256(content).hexdigest()
            waiting += _imported(path, content) if path.suffix == ".py" else ()
    HASHED.update((str(path), content) for path, content in hashes.items())
    return hashed(*sorted(hashes.values())) if hashes else ""


def _imported(path: Path, content: bytes) -> Iterator[Path]:
    """Yield the files that a Python file imports from its own folder and from its package."""
    roots = [path.parent]
    while (roots[-1] / "__init__.py").exists():
        roots.append(roots[-1].parent)
    nodes: Iterable[ast.AST] = ()
    with suppress(SyntaxError):  # a file that does not compile cannot have been imported
        nodes = ast.walk(ast.parse(content))
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield from _found(roots, alias.name)
        elif isinstance(node, ast.ImportFrom):
            places = [path.parents[node.level - 1]] if node.level else roots
            for alias in node.names:
                yield from _found(places, ".".join(filter(None, (node.module, alias.name))))


def _found(folders: Iterable[Path], module: str) -> Iterator[Path]:
    """Yield the files of a module and of its parents in these folders."""
    parts = module.split(".")
    for folder in folders:
        places = [folder.joinpath(*parts[: n + 1]) for n in range(len(parts))]
        yield from (
            file for place in places for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file()
        )
