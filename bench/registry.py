"""Finds plugins, their parameters and whether they can be used here.

Built-in plugins are the files under ``plugins/<kind>/``; third-party ones come through the entry-point group
``bench.plugins``, each entry naming a plugin class. Importing a plugin must stay cheap: heavy libraries are named
in ``requires`` and imported by the plugin when it is used.
"""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import importlib
import importlib.machinery
import importlib.util
import inspect
import math
import pkgutil
import types
import typing
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar, cast

from bench.contracts import Backend, ContactLaw, Estimator, Integrator, Plugin, Scene
from bench.errors import UserError, unknown

KINDS: dict[str, type[Plugin]] = {
    "scenes": Scene,
    "contacts": ContactLaw,
    "integrators": Integrator,
    "backends": Backend,
    "estimators": Estimator,
}
ENTRY_POINT_GROUP = "bench.plugins"


Function = TypeVar("Function", bound=Callable[..., Any])


def remember(function: Function) -> Function:
    """``functools.cache`` with the function's own type; mypy does not take a dataclass's class for hashable."""
    return cast(Function, cache(function))


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


@dataclass(frozen=True)
class Parameter:
    """One parameter of a plugin."""

    name: str
    type: Any
    default: Any
    unit: str = ""
    doc: str = ""
    positive: bool = False
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] | None = None


@remember
def entries() -> dict[str, dict[str, Entry]]:
    """All plugins by kind and name."""
    found: dict[str, dict[str, Entry]] = {kind: {} for kind in KINDS}
    for kind in KINDS:
        package = importlib.import_module(f"plugins.{kind}")
        for module in sorted(pkgutil.iter_modules(package.__path__), key=lambda m: m.name):
            _load_module(found, kind, f"{package.__name__}.{module.name}", module.name)
    for point in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda p: p.name):
        try:
            plugin = point.load()
        except Exception as error:
            _load_failure(found, point.name, error)
        else:
            if isinstance(plugin, type) and issubclass(plugin, Plugin) and plugin.kind in KINDS:
                _add(found, plugin)
            else:
                _load_failure(found, point.name, TypeError(f"{point.value} is not a plugin class"))
    return found


def _load_module(found: dict[str, dict[str, Entry]], kind: str, path: str, name: str) -> None:
    try:
        module = importlib.import_module(path)
    except Exception as error:
        found[kind][name] = Entry(kind, name, None, f"import failed: {type(error).__name__}: {error}")
        return
    for plugin in vars(module).values():
        own = isinstance(plugin, type) and plugin.__module__ == module.__name__
        if own and issubclass(plugin, KINDS[kind]) and plugin.name and not inspect.isabstract(plugin):
            _add(found, plugin)


def _load_failure(found: dict[str, dict[str, Entry]], name: str, error: Exception) -> None:
    reason = f"import failed: {type(error).__name__}: {error}"
    kind = next((k for k in KINDS if name.startswith(k)), "estimators")
    found[kind][name] = Entry(kind, name, None, reason)


def _add(found: dict[str, dict[str, Entry]], plugin: type[Plugin]) -> None:
    if plugin.name in found[plugin.kind]:
        taken = found[plugin.kind][plugin.name].plugin
        raise UserError(f"two plugins are called '{plugin.name}' in {plugin.kind}: {taken} and {plugin}")
    found[plugin.kind][plugin.name] = Entry(plugin.kind, plugin.name, plugin, _missing(plugin))


def _missing(plugin: type[Plugin]) -> str:
    missing = []
    for requirement in plugin.requires:
        module, _, distribution = requirement.partition("=")
        if not _installed(module):
            missing.append(distribution or module)
    return f"not installed: {', '.join(missing)}; pip install {' '.join(missing)}" if missing else ""


def _installed(module: str) -> bool:
    """Whether a module can be imported, found without importing it or its parents."""
    first, *inner = module.split(".")
    spec = importlib.util.find_spec(first)
    for part in inner:
        if spec is None:
            return False
        spec = importlib.machinery.PathFinder.find_spec(f"{spec.name}.{part}", spec.submodule_search_locations)
    return spec is not None


def find(kind: str, name: str) -> Entry:
    """The entry of that name; raises :class:`UserError` with the nearest name otherwise."""
    table = entries()[kind]
    if name not in table:
        raise unknown(kind.removesuffix("s"), name, table)
    return table[name]


# --------------------------------------------------------------------------------------------- parameters


@remember
def parameters(plugin: type[Plugin]) -> dict[str, Parameter]:
    """The parameters of a plugin by name."""
    hints = typing.get_type_hints(plugin)
    return {
        f.name: Parameter(
            f.name, hints[f.name], f.default, **{k: v for k, v in f.metadata.items() if k in Parameter.__annotations__}
        )
        for f in dataclasses.fields(plugin)
    }


def build(plugin: type[Plugin], values: Mapping[str, Any]) -> Plugin:
    """An instance with checked parameter values; raises :class:`UserError` for a bad name, type or value."""
    known = parameters(plugin)
    checked = {}
    for name, value in values.items():
        if name not in known:
            raise unknown(f"parameter of {plugin.kind.removesuffix('s')} {plugin.name}", name, known)
        checked[name] = check(known[name], value, f"{plugin.name}.{name}")
    return plugin(**checked)


def check(parameter: Parameter, value: Any, where: str) -> Any:
    """``value`` as the parameter's type; raises :class:`UserError` when it is not one or is out of bounds."""
    kinds = typing.get_args(parameter.type) if isinstance(parameter.type, types.UnionType) else (parameter.type,)
    if value is None and type(None) in kinds:
        return None
    kind = next(k for k in kinds if k is not type(None))
    result = coerce(kind, value, where)
    if isinstance(result, int | float) and not isinstance(result, bool):
        if parameter.positive and not result > 0:
            raise UserError(f"{where}={value} must be greater than 0")
        if parameter.low is not None and result < parameter.low:
            raise UserError(f"{where}={value} must be at least {parameter.low}")
        if parameter.high is not None and result > parameter.high:
            raise UserError(f"{where}={value} must be at most {parameter.high}")
    if parameter.choices is not None and result not in parameter.choices:
        raise unknown(f"value for {where}:", result, parameter.choices)
    return result


def coerce(kind: Any, value: Any, where: str) -> Any:
    """``value`` as ``kind`` (bool, int, float or str) where that loses nothing; else :class:`UserError`."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind is float:
        if isinstance(value, str):
            try:
                value, number = float(value), True
            except ValueError:
                number = False
        if number and not math.isnan(value):
            return float(value)
    elif kind is int:
        if number and float(value).is_integer():
            return int(value)
    elif (kind is bool and isinstance(value, bool)) or (kind is str and isinstance(value, str)):
        return value
    article = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}.get(kind, str(kind))
    raise UserError(f"{where}={value!r} must be {article}, not {type(value).__name__}")


# ----------------------------------------------------------------------------------------- identity strings


def identity(name: str, values: Mapping[str, Any]) -> str:
    """``alpha_order[delta=0.1,gamma=0.01]``, or the bare name without values."""
    text = ",".join(f"{key}={_text(values[key])}" for key in sorted(values))
    return f"{name}[{text}]" if text else name


def _text(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, float) and not value.is_integer() else _short(value)


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) and float(f"{value:g}") == value else str(value)


def parse_identity(text: str) -> tuple[str, dict[str, Any]]:
    """Name and raw values of an identity string; raises :class:`UserError` when it is malformed."""
    import yaml

    name, bracket, rest = str(text).partition("[")
    values: dict[str, Any] = {}
    if bracket:
        if not rest.endswith("]"):
            raise UserError(f"'{text}' is not a plugin: write name or name[parameter=value,...]")
        for item in filter(None, rest[:-1].split(",")):
            key, equals, value = item.partition("=")
            if not equals:
                raise UserError(f"'{item}' in '{text}' is not parameter=value")
            values[key.strip()] = yaml.safe_load(value)
    return name.strip(), values


# ------------------------------------------------------------------------------------------- source hashes


@remember
def source_hash(plugin: type[Plugin]) -> str:
    """Hash of the files a plugin is written in: its own module and those it imports from its own package."""
    return hash_of(sources(plugin.__module__))


def hash_of(paths: Iterable[Path]) -> str:
    """Hash of the contents of files, whatever their names."""
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def sources(module: str, without: Collection[str] = ()) -> set[Path]:
    """Files of a module and of all it imports from its own package, at its top or later, but for those named ``without``."""
    found: dict[str, Path] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        path = None if name in found or name in without else _file(name)
        if path is not None:
            found[name] = path
            waiting.extend(_imports(name, path))
    return set(found.values())


def _imports(module: str, path: Path) -> Iterator[str]:
    """What a file imports from its own package; ``from a import b`` may mean the module ``a.b`` or a name in ``a``."""
    package = module.partition(".")[0]
    parent = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), parent)
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)]
        yield from (name for name in names if name.partition(".")[0] == package)


@remember
def _file(module: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    origin = spec.origin if spec is not None else None
    return Path(origin) if origin is not None and origin.endswith(".py") else None
