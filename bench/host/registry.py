"""The registry of plugins: finds plugins and reports whether they are available.

Built-in plugins are the files and packages under ``plugins/<kind>/``. Others come from folders passed to
:func:`add_folder` and from the entry-point group ``bench.plugins``, in which each entry names a plugin class. Importing
a plugin must be fast: a plugin lists heavy libraries in ``requires`` and imports them only when it runs.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.machinery
import importlib.util
import inspect
import os
import pkgutil
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from bench.errors import FOLDER, UserError, printable, unknown
from bench.host import guard, reads, trial
from bench.host.parameters import Plugin, build, parameters, remember, singular

BUILT_IN = "bench.plugins"
"""The package of the built-in plugins."""
KINDS = (
    "scenes",
    "contacts",
    "integrators",
    "backends",
    "estimators",
    "optimizers",
    "policies",
    "trainers",
    "studies",
)
"""The built-in kinds, in listing order. A plugin may declare another kind."""
OTHER_PACKAGES = ("engines", "robots")
"""Names of the folders with files that only the Pythons of engines import, and with models of robots."""
NAME = re.compile(r"\w[\w.-]*")
"""Pattern of plugin names. Brackets, commas and spaces are syntax of identity strings, so names contain none."""
MAX_REASON_CHARACTERS = 1000
"""Maximum length of a stored reason."""


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
        """Whether the plugin is loaded and its required modules are installed."""
        return not self.reason


Table = dict[str, dict[str, Entry]]
_folders: list[Path] = []
_environment: dict[str, str | None] = {}
"""Variables of the environment that imports from outside have changed, with their values before."""
IMPORTED: set[str] = set()
"""The modules from outside that this process has imported."""
_only: frozenset[str] | None = None
"""The only modules from outside that are loaded; None for all."""


def add_folder(path: Path) -> None:
    """Register the plugins in a folder and its subfolders; raises :class:`UserError` if ``path`` is not a folder."""
    path = path.expanduser().absolute()
    if not path.is_dir():
        raise UserError(f"plugins={path} is not a folder")
    if path not in _folders:
        _folders.append(path)
        reads.start(str(path))
        package = ModuleType(_package(path), f"Plugins from {path}.")
        package.__path__ = [str(path)]
        sys.modules[package.__name__] = package
        entries.cache_clear()  # type: ignore[attr-defined]


def folders() -> tuple[Path, ...]:
    """Return the registered plugin folders."""
    return tuple(_folders)


def restrict(modules: frozenset[str] | None) -> None:
    """Load, of the modules from outside, only ``modules``, until another name is searched for; None to load all."""
    global _only
    if modules != _only:
        _only = modules
        entries.cache_clear()  # type: ignore[attr-defined]


def is_restricted() -> bool:
    """Return whether some modules from outside may not have been loaded."""
    return _only is not None


def _package(path: Path) -> str:
    """Return the folder's package name, which is unique and the same in every process, so that plugins can be pickled."""
    return f"{FOLDER}{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"


@remember
def entries() -> Table:
    """Return all plugins by kind and name."""
    table: Table = {kind: {} for kind in KINDS}
    needed = None if _only is None else {name.partition(".")[0] for name in _only}
    packages = {_package(path): path for path in _folders if needed is None or _package(path) in needed}
    modules = [module for name in (BUILT_IN, *packages) for module in _modules(importlib.import_module(name))]
    # only one command uses these: entries_with has them, and other commands do not import them
    modules = [part for part in modules if not part[1].startswith("bench.plugins.claims")]
    points = sorted(entry_points(group="bench.plugins"), key=lambda p: p.name)
    if _only is not None:
        modules = [part for part in modules if part[1].startswith(BUILT_IN) or part[1] in _only]
        points = [point for point in points if point.module in _only]
    outside = [*(name for _, name in modules if not name.startswith(BUILT_IN)), *(point.module for point in points)]
    fatal = trial.find_fatal_modules(outside, packages) if _only is None else {}
    for kind, module in modules:
        _load(table, kind, module, partial(importlib.import_module, module), fatal)
    for point in points:
        _load(table, "", point.module, point.load, fatal, point.name)
    return table


@contextmanager
def _protected(module: str) -> Iterator[None]:
    """Quote what the import of a module prints, and keep what it changes in the environment from new processes."""
    before = dict(os.environ)
    with guard.capture_output(f"{printable(module)}, while it was imported,"), guard.protect_process():
        try:
            yield
        finally:
            changed = {name for name in before | os.environ if before.get(name) != os.environ.get(name)}
            _environment.update({name: before.get(name) for name in changed - _environment.keys()})


def environment() -> dict[str, str]:
    """Return the environment of new processes: without what imports from outside have changed in it."""
    return {name: value for name, value in (os.environ | _environment).items() if value is not None}


def entries_with(kind: str) -> dict[str, Entry]:
    """Return all plugins of a kind on demand: built-in ones, those of entry points ``bench.KIND`` and of the registry.

    An entry point names a plugin class or a module with several.
    """
    table: Table = {kind: {}}
    for _, module in _modules(importlib.import_module(f"bench.plugins.{kind}")):
        _load(table, kind, module, partial(importlib.import_module, module))
    for point in sorted(entry_points(group=f"bench.{kind}"), key=lambda p: p.name):
        _load(table, kind, point.module, point.load, name=point.name)
    for name, entry in entries().get(kind, {}).items():
        if entry.plugin is None:
            table[kind].setdefault(name, entry)
        else:
            _add(table, entry.plugin)
    return table[kind]


def kinds() -> list[str]:
    """Return the kinds of all plugins, built-in kinds first."""
    return list(entries())


def _modules(package: ModuleType) -> Iterator[tuple[str, str]]:
    """Yield (kind, full name) of each module in a package and its subfolders; the kind is the module's folder name."""
    for path in sorted(path for place in package.__path__ for path in Path(place).iterdir()):
        name, is_package = path.stem, (path / "__init__.py").exists()
        full = f"{package.__name__}.{name}"
        # a folder of plugins need not have an __init__.py
        is_folder = path.is_dir() and name.isidentifier() and not is_package and any(path.glob("*.py"))
        if name in OTHER_PACKAGES or name == "__init__" or "." in name:
            continue
        if is_folder or (is_package and name in KINDS):
            for module in pkgutil.iter_modules(importlib.import_module(full).__path__):
                yield name, f"{full}.{module.name}"
        elif is_package or path.suffix == ".py":
            yield package.__name__.rpartition(".")[2], full


def _load(
    table: Table,
    kind: str,
    module: str,
    load: Callable[[], Any],
    fatal: Mapping[str, str] | None = None,
    name: str = "",
) -> None:
    """Add the plugin class, or the classes of the module, that ``load`` returns; what cannot be loaded with its error."""
    name = name or module.rpartition(".")[2]
    try:
        if message := (fatal or {}).get(module):
            raise ImportError(message)
        if not module.startswith("bench."):
            IMPORTED.add(module)
            reads.start(plugin=module)
        with _protected(module):
            part = load()
            if isinstance(part, ModuleType):
                _add_members(table, kind, part)
            elif isinstance(part, type) and issubclass(part, Plugin) and part.kind and kind in ("", part.kind):
                _add(table, part)
            else:
                value = f"{module}:{getattr(part, '__name__', part)}"
                raise TypeError(f"{value} is not a plugin class{kind and f' of kind {kind}'}")
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # includes SystemExit: a plugin neither hides the others nor ends the command
        _add_unavailable(table, kind if kind in table else _kind_in_source(module), name, error, module)


def _add_members(table: Table, kind: str, module: ModuleType) -> None:
    """Add the plugin classes that a module defines to the table."""
    for name, plugin in list(vars(module).items()):
        try:
            own = isinstance(plugin, type) and str(plugin.__module__).startswith(module.__name__)
            concrete = own and issubclass(plugin, Plugin) and plugin.kind and plugin.name != ""
        except Exception as error:
            _add_unavailable(
                table, kind if kind in table else "estimators", name, error, module.__name__, "cannot be used"
            )
            continue
        if concrete:
            _add(table, plugin)


def _kind_in_source(path: str) -> str:
    """Return the kind of the first contract that a module's source names, without its import; else ``estimators``."""
    folder, _, name = path.rpartition(".")
    file = Path(*getattr(sys.modules.get(folder), "__path__", ()), f"{name}.py")
    words = re.findall(r"\w+", file.read_text(errors="replace")) if file.exists() else ()
    kinds = (getattr(vars(sys.modules["bench.model"]).get(word), "kind", "") for word in words)
    return next((kind for kind in kinds if kind in KINDS), "estimators")


def _add_unavailable(
    table: Table, kind: str, name: str, error: BaseException, module: str, problem: str = "import failed"
) -> None:
    message = printable(error)[:MAX_REASON_CHARACTERS] + _place(error, str(module))
    while name in table[kind]:  # do not replace an entry of the same name
        name += " (another)"
    table[kind][name] = Entry(kind, name, None, f"{problem}: {type(error).__name__}: {message}")


def _place(error: BaseException, module: str) -> str:
    """Return the file of a module, and the line that raised the error, in brackets; a syntax error has them already."""
    file = f"{module.rpartition('.')[2]}.py"
    frames = traceback.extract_tb(error.__traceback__)
    lines = [f":{frame.lineno}" for frame in frames if Path(frame.filename).name == file]
    is_needed = lines or (module.startswith(FOLDER) and not isinstance(error, SyntaxError))
    return f" ({file}{(lines or [''])[-1]})" if is_needed else ""


def _add(table: Table, plugin: type[Plugin]) -> None:
    where = printable(f"{plugin.__module__}.{plugin.__qualname__}")
    kind = plugin.kind if isinstance(plugin.kind, str) and plugin.kind.isidentifier() else "estimators"
    kind_entries = table.setdefault(kind, {})
    try:
        faults = _faults(plugin)
    except Exception as error:
        _add_unavailable(table, kind, where, error, plugin.__module__, "cannot be used")
        return
    if faults:
        # listed by its full class path: its own name may be invalid, and classes of several files may share a name
        kind_entries[where] = Entry(kind, where, None, f"cannot be used: {faults}")
        return
    taken = kind_entries.get(plugin.name)
    if taken is not None and taken.plugin is not plugin:
        by = taken.plugin and printable(f"{taken.plugin.__module__}.{taken.plugin.__qualname__}")
        kind_entries[f"{plugin.name} of {where}"] = Entry(
            kind, plugin.name, None, f"the name is taken by {by or taken.name}"
        )
    elif inspect.isabstract(plugin):
        missing = ", ".join(sorted(plugin.__abstractmethods__))
        kind_entries[plugin.name] = Entry(kind, plugin.name, None, f"{plugin.__qualname__} does not define {missing}")
    else:
        kind_entries[plugin.name] = Entry(kind, plugin.name, plugin, missing_modules(plugin))


def _faults(plugin: type[Plugin]) -> str:
    """Return why a class is not a valid plugin, or an empty string. Reading its parameters may raise any exception."""
    if not (isinstance(plugin.kind, str) and plugin.kind.isidentifier()):
        return f"kind={printable(repr(plugin.kind))[:MAX_REASON_CHARACTERS]} must be a name"
    if not (isinstance(plugin.name, str) and NAME.fullmatch(plugin.name)):
        return f"name={printable(repr(plugin.name))[:MAX_REASON_CHARACTERS]} must be letters, digits, '_', '-' and '.'"
    if not (isinstance(plugin.requires, tuple | list) and all(isinstance(r, str) and r for r in plugin.requires)):
        return f"requires={printable(repr(plugin.requires))[:MAX_REASON_CHARACTERS]} must be a tuple of modules"
    for parameter in parameters(plugin).values():
        if not set(parameter.kinds) - {type(None)} <= {bool, int, float, str} or set(parameter.kinds) <= {type(None)}:
            return f"parameter {parameter.name} must be annotated as bool, int, float or str"
    return ""


def missing_modules(plugin: type[Plugin]) -> str:
    """Return which modules that a plugin requires are not installed and how to install them, or an empty string."""
    parts = (requirement.partition("=") for requirement in plugin.requires)
    absent = [distribution or module for module, _, distribution in parts if not installed(module)]
    return f"not installed: {', '.join(absent)}; pip install {' '.join(absent)}" if absent else ""


def installed(module: str) -> bool:
    """Return whether a module is installed, without importing the module or its parents."""
    first, *inner = module.split(".")
    spec = importlib.util.find_spec(first)
    for part in inner:
        if spec is None:
            return False
        spec = importlib.machinery.PathFinder.find_spec(f"{spec.name}.{part}", spec.submodule_search_locations)
    return spec is not None


def find(kind: str, name: str) -> Entry:
    """Return the entry of a plugin; raises :class:`UserError` with the nearest name if there is none."""
    if name not in entries().get(kind, {}):
        restrict(None)  # a parameter of another plugin may name it
    table = entries().get(kind, {})
    if name not in table:
        raise unknown_plugin(singular(kind), name, table, f"list {kind}")
    return table[name]


def unknown_plugin(what: str, name: str, known: Iterable[str], see: str) -> UserError:
    """Return the error for an unknown plugin, with the reasons of all plugins that could not be loaded."""
    failed = [f"{e.name}: {e.reason}" for table in entries().values() for e in table.values() if e.plugin is None]
    return UserError("; ".join([str(unknown(what, name, known, see)), *failed]))


def usable(kind: str, name: str) -> type[Plugin]:
    """Return a plugin class; raises :class:`UserError` if the name is unknown or the class could not be loaded."""
    entry = find(kind, name)
    if entry.plugin is None:
        raise UserError(f"{singular(kind)} '{name}' cannot be used: {entry.reason}")
    return entry.plugin


def make(kind: str, name: str, values: Mapping[str, Any] | None = None) -> Any:
    """Return an instance of a plugin with validated parameter values; raises :class:`UserError` if invalid."""
    return build(usable(kind, name), values or {})


def kind_of(axis: str) -> str:
    """Return the kind of an axis: ``scenes`` for ``scene``; raises :class:`UserError` for an unknown axis."""
    known = {singular(kind): kind for kind in reversed(kinds())}
    if axis not in known:
        raise unknown("axis", axis, known)
    return known[axis]
