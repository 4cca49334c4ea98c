"""Finds plugins and reports whether they can be used here.

Built-in plugins are the files under ``plugins/<kind>/`` and the folders under ``bench/studies/``; others come from
folders that :func:`add_folder` names, and through the entry-point group ``bench.plugins``, each entry naming a plugin
class. Importing a plugin must stay cheap: heavy libraries are named in ``requires`` and imported by the plugin when it
is used.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.machinery
import importlib.util
import inspect
import pkgutil
import re
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from bench.errors import UserError, printable, unknown
from bench.model import guard, trial
from bench.model.parameters import Plugin, build, parameters, remember, singular

CORE = "bench.studies"
"""What is no plugin file of anyone's: its import is not tried first."""
BUILT_IN = ("bench.plugins", CORE)
KINDS = ("scenes", "contacts", "integrators", "backends", "estimators", "optimizers", "studies")
"""The kinds that come with the package, in the order in which they are listed; a plugin may declare another."""
ENTRY_POINT_GROUP = "bench.plugins"
NAME = re.compile(r"\w[\w.-]*")
"""Names of plugins: they stand in identity strings, where brackets, commas and spaces have a meaning."""
LONGEST = 1000
"""Letters of a reason that are kept."""


@dataclass(frozen=True)
class Entry:
    """One registered plugin: its class, or why it could not be loaded."""

    kind: str
    name: str
    plugin: type[Plugin] | None
    reason: str = ""
    """Why it is unavailable, with the install command; empty when it is available."""

    @property
    def available(self) -> bool:
        """Whether it can be used."""
        return not self.reason


Table = dict[str, dict[str, Entry]]
_folders: list[Path] = []


def add_folder(path: Path) -> None:
    """Find plugins in a folder's ``.py`` files and its subfolders too; raises :class:`UserError` for a non-folder."""
    path = path.expanduser().absolute()
    if not path.is_dir():
        raise UserError(f"plugins={path} is not a folder")
    if path not in _folders:
        _folders.append(path)
        package = ModuleType(_package(path), f"Plugins from {path}.")
        package.__path__ = [str(path)]
        sys.modules[package.__name__] = package
        entries.cache_clear()  # type: ignore[attr-defined]


def folders() -> tuple[Path, ...]:
    """Return the folders that were added."""
    return tuple(_folders)


def _package(path: Path) -> str:
    """Return a package name unique to the folder and equal in every process, so that its plugins can be pickled."""
    return f"bench_folder_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"


@remember
def entries() -> Table:
    """Return all plugins by kind and name."""
    table: Table = {kind: {} for kind in KINDS}
    packages = (*BUILT_IN, *map(_package, _folders))
    modules = [found for name in packages for found in _modules(importlib.import_module(name))]
    points = sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda p: p.name)
    stamps = {module: trial.stamp(module) for _, module in modules if not module.startswith(CORE)}
    stamps |= {point.module: point.dist.version if point.dist else "" for point in points}
    fatal = trial.fatal(stamps, {_package(path): path for path in _folders})
    for kind, module in modules:
        with guard.quiet(f"{module}, while it was imported,"), guard.guarded():
            _load_module(table, kind, module, fatal.get(module, ""))
    for point in points:
        try:
            if point.module in fatal:
                raise ImportError(fatal[point.module])
            with guard.quiet(f"{point.module}, while it was imported,"), guard.guarded():
                plugin = point.load()
            if not (isinstance(plugin, type) and issubclass(plugin, Plugin) and plugin.kind):
                raise TypeError(f"{point.value} is not a plugin class")
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # a plugin that exits at import, too, must not end the command
            _fail(table, _guessed_kind(point.name), point.name, error)
        else:
            _add(table, plugin)
    return table


def kinds() -> list[str]:
    """Return the kinds of all plugins, those of the package first."""
    return list(entries())


def _modules(package: ModuleType) -> Iterator[tuple[str, str]]:
    """Yield kind (the folder's name where that is one) and name of each module of a package and of its folders."""
    for module in sorted(pkgutil.iter_modules(package.__path__), key=lambda m: m.name):
        name = f"{package.__name__}.{module.name}"
        if module.name in KINDS:
            yield from ((module.name, path) for _, path in _modules(importlib.import_module(name)))
        else:
            yield package.__name__.rpartition(".")[2], name
    for folder in sorted(path for place in package.__path__ for path in Path(place).iterdir()):
        # folders without __init__.py are packages too, and pkgutil does not list them
        bare = folder.is_dir() and folder.name.isidentifier() and not (folder / "__init__.py").exists()
        if bare and any(folder.glob("*.py")):
            space = importlib.import_module(f"{package.__name__}.{folder.name}")
            for module in sorted(pkgutil.iter_modules(space.__path__), key=lambda m: m.name):
                yield folder.name, f"{space.__name__}.{module.name}"


def _load_module(found: Table, kind: str, path: str, fatal: str) -> None:
    try:
        if fatal:
            raise ImportError(fatal)
        module = importlib.import_module(path)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        # one broken plugin must not hide the others, nor end the command by sys.exit(): it is listed with its error
        _fail(found, kind if kind in found else "estimators", path.rpartition(".")[2], error)
        return
    for name, plugin in list(vars(module).items()):
        try:
            own = isinstance(plugin, type) and str(plugin.__module__).startswith(module.__name__)
            concrete = own and issubclass(plugin, Plugin) and plugin.kind and plugin.name != ""
        except Exception as error:
            _fail(found, kind if kind in found else "estimators", name, error, "cannot be used")
            continue
        if concrete:
            _add(found, plugin)


def _guessed_kind(name: str) -> str:
    return next((kind for kind in KINDS if name.startswith(kind)), "estimators")


def _fail(found: Table, kind: str, name: str, error: BaseException, what: str = "import failed") -> None:
    said = printable(error)[:LONGEST]
    while name in found[kind]:  # a sound plugin keeps its name
        name += " (another)"
    found[kind][name] = Entry(kind, name, None, f"{what}: {type(error).__name__}: {said}")


def _add(found: Table, plugin: type[Plugin]) -> None:
    where = printable(f"{plugin.__module__}.{plugin.__qualname__}")
    kind = plugin.kind if isinstance(plugin.kind, str) and plugin.kind.isidentifier() else "estimators"
    table = found.setdefault(kind, {})
    try:
        faults = _faults(plugin)
    except Exception as error:
        _fail(found, kind, where, error, "cannot be used")
        return
    if faults:
        # by its place: what it calls itself may be no name, and classes of several files may be called alike
        table[where] = Entry(kind, where, None, f"cannot be used: {faults}")
        return
    taken = table.get(plugin.name)
    if taken is not None and taken.plugin is not plugin:
        by = taken.plugin and f"{taken.plugin.__module__}.{taken.plugin.__qualname__}"
        table[f"{plugin.name} of {where}"] = Entry(kind, plugin.name, None, f"the name is taken by {by or taken.name}")
    elif inspect.isabstract(plugin):
        missing = ", ".join(sorted(plugin.__abstractmethods__))
        table[plugin.name] = Entry(kind, plugin.name, None, f"{plugin.__qualname__} does not define {missing}")
    else:
        table[plugin.name] = Entry(kind, plugin.name, plugin, _missing(plugin))


def _faults(plugin: type[Plugin]) -> str:
    """Return what makes a class unusable as a plugin before it is used; its parameters are read, and may raise."""
    if not (isinstance(plugin.kind, str) and plugin.kind.isidentifier()):
        return f"kind={printable(repr(plugin.kind))[:LONGEST]} must be a name"
    if not (isinstance(plugin.name, str) and NAME.fullmatch(plugin.name)):
        return f"name={printable(repr(plugin.name))[:LONGEST]} must be letters, digits, '_', '-' and '.'"
    if not (isinstance(plugin.requires, tuple | list) and all(isinstance(r, str) and r for r in plugin.requires)):
        return f"requires={printable(repr(plugin.requires))[:LONGEST]} must be a tuple of modules"
    for parameter in parameters(plugin).values():
        kinds = typing.get_args(parameter.type) if isinstance(parameter.type, types.UnionType) else (parameter.type,)
        if not kinds or not set(kinds) <= {bool, int, float, str, type(None)} or kinds == (type(None),):
            return f"parameter {parameter.name} must be annotated as bool, int, float or str"
    return ""


def _missing(plugin: type[Plugin]) -> str:
    missing = []
    for requirement in plugin.requires:
        module, _, distribution = requirement.partition("=")
        if not installed(module):
            missing.append(distribution or module)
    return f"not installed: {', '.join(missing)}; pip install {' '.join(missing)}" if missing else ""


def installed(module: str) -> bool:
    """Return whether a module can be imported, without importing it or its parents."""
    first, *inner = module.split(".")
    spec = importlib.util.find_spec(first)
    for part in inner:
        if spec is None:
            return False
        spec = importlib.machinery.PathFinder.find_spec(f"{spec.name}.{part}", spec.submodule_search_locations)
    return spec is not None


def find(kind: str, name: str) -> Entry:
    """Return the entry of that name; raises :class:`UserError` with the nearest name if there is none."""
    table = entries().get(kind, {})
    if name not in table:
        raise unknown(singular(kind), name, table)
    return table[name]


def usable(kind: str, name: str) -> type[Plugin]:
    """Return the plugin class of that name; raises :class:`UserError` if it does not exist or could not be loaded."""
    entry = find(kind, name)
    if entry.plugin is None:
        raise UserError(f"{singular(kind)} '{name}' cannot be used: {entry.reason}")
    return entry.plugin


def make(kind: str, name: str, values: Mapping[str, Any] | None = None) -> Any:
    """Return an instance of the plugin of that name with checked parameter values."""
    return build(usable(kind, name), values or {})


def kind_of(axis: str) -> str:
    """Return the kind of plugins on an axis: ``scenes`` for ``scene``; raises :class:`UserError` if there is none."""
    known = _by_axis(tuple(kinds()))
    if axis not in known:
        raise unknown("axis", axis, known)
    return known[axis]


@cache
def _by_axis(kinds: tuple[str, ...]) -> dict[str, str]:
    return {singular(kind): kind for kind in reversed(kinds)}
