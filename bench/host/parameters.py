"""Plugins and their parameters: declaration, validation, and construction from values."""

from __future__ import annotations

import dataclasses
import math
import sys
import types
import typing
from abc import ABC
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, Self, TypeVar, cast

from bench.errors import UserError, printable, unknown

LARGEST = 2**53
"""The largest allowed integer: all integers up to it are exact in float64, the type of numeric result columns."""
Function = TypeVar("Function", bound=Callable[..., Any])


def remember(function: Function) -> Function:
    """Cache a function like ``functools.cache``, but preserve its type for type checkers."""
    return cast(Function, cache(function))


def param(
    default: Any,
    doc: str = "",
    unit: str = "",
    *,
    positive: bool = False,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] | None = None,
    added: bool = False,
) -> Any:
    """Declare a plugin parameter: its default, meaning, unit and allowed values.

    ``positive`` requires a value above 0, ``low`` and ``high`` are inclusive bounds, and ``choices`` are the allowed
    strings. ``added`` is for a parameter that a released plugin gains: only values other than its default count in keys,
    so stored rows stay valid, and Python takes it by keyword only.
    """
    return dataclasses.field(
        default=default,
        kw_only=added,
        metadata=dict(
            doc=doc,
            unit=unit,
            positive=positive,
            low=low,
            high=high,
            choices=choices,
            added=added,
        ),
    )


@dataclass(frozen=True)
class Plugin(ABC):  # noqa: B024, each kind has its own abstract methods
    """The base class of all plugins: a name, and parameters as dataclass fields."""

    kind: ClassVar[str] = ""
    """Its kind, the plural of its axis: ``scenes``, ``contacts``, ``studies``, ..., or a new one."""
    name: ClassVar[str] = ""
    """Its name on the command line and in tables, legends and caches."""
    revision: ClassVar[int] = 1
    """Raised by a class of this package when a stored number that it decides moves. Each class has its own."""
    uses: ClassVar[tuple[types.ModuleType, ...]] = ()
    """Modules whose ``REVISION`` counts too: helpers that several plugins share."""
    requires: ClassVar[tuple[str, ...]] = ()
    """Modules that must be installed for the plugin to be available, as ``module`` or ``module=distribution``."""

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        _inherit(cls)

    def __new__(cls, *_: Any, **__: Any) -> Self:
        """Return a new instance; raises :class:`UserError` if the class or a base lacks ``@dataclass``."""
        require_decorated(cls)
        return super().__new__(cls)

    def unavailable_reason(self) -> str | None:
        """Return why an instance with these parameters cannot be used here, with what to install, or None."""
        return None


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
    added: bool = False

    @property
    def kinds(self) -> tuple[Any, ...]:
        """The types of its values: ``float`` and ``NoneType`` for ``float | None``."""
        return typing.get_args(self.type) if isinstance(self.type, types.UnionType) else (self.type,)


def _inherit(plugin: type[Plugin]) -> None:
    """Let ``steps: int = 60`` change an inherited parameter's default only, with its meaning, unit and bounds.

    Raises TypeError if a class sets an inherited parameter without an annotation, which would not change its default.
    """
    owners = [base for base in reversed(plugin.__mro__[1:]) if "__dataclass_fields__" in vars(base)]
    inherited = {field.name: field for base in owners for field in dataclasses.fields(base)}
    own = vars(plugin).get("__annotations__", {})
    for name, field in inherited.items():
        if name not in vars(plugin):
            continue
        value, annotation = vars(plugin)[name], field.type if isinstance(field.type, str) else field.type.__name__
        if name not in own:
            raise TypeError(
                f"{plugin.__name__}.{name} replaces a parameter without an annotation, so the parameter would keep its "
                f"default {field.default!r}: write `{name}: {annotation} = {value!r}`"
            )
        if not isinstance(value, dataclasses.Field | property):
            setattr(plugin, name, dataclasses.field(default=value, metadata=field.metadata))


@remember
def require_decorated(plugin: type[Plugin]) -> None:
    """Raise :class:`UserError` if a plugin class or a base of it declares parameters but is not a dataclass."""
    for owner in plugin.__mro__:
        if "__dataclass_fields__" in vars(owner) or not issubclass(owner, Plugin):
            continue
        annotations = vars(owner).get("__annotations__", {})
        lost = [name for name, annotation in annotations.items() if "ClassVar" not in str(annotation)]
        lost += [
            name for name, value in vars(owner).items() if isinstance(value, dataclasses.Field) and name not in lost
        ]
        if lost:
            raise UserError(
                f"{owner.__name__} declares parameters ({', '.join(lost)}) but is not a dataclass, so they would be "
                f"ignored: write @dataclass(frozen=True) above `class {owner.__name__}`"
            )


@remember
def parameters(plugin: type[Plugin]) -> dict[str, Parameter]:
    """Return the parameters of a plugin class by name; raises :class:`UserError` if it lacks ``@dataclass``."""
    require_decorated(plugin)
    hints = typing.get_type_hints(plugin)
    return {
        f.name: Parameter(
            f.name, hints[f.name], f.default, **{k: v for k, v in f.metadata.items() if k in Parameter.__annotations__}
        )
        for f in sorted(dataclasses.fields(plugin), key=lambda field: field.metadata.get("added", False))
    }


def values(plugin: Plugin) -> dict[str, Any]:
    """Return all parameters of a plugin with their values, defaults included."""
    return {name: getattr(plugin, name) for name in parameters(type(plugin))}


def traced(plugin: Plugin) -> list[str]:
    """Return the names of the float parameters, which a backend may trace and theta may include."""
    return [f.name for f in dataclasses.fields(plugin) if f.type in ("float", float)]


def build(plugin: type[Plugin], values: Mapping[str, Any]) -> Plugin:
    """Build an instance with validated parameter values.

    Raises :class:`UserError` for an unknown name or an invalid type or value, and if the plugin's own code fails or
    exits.
    """
    declared = parameters(plugin)
    checked = {}
    for name, value in values.items():
        if name not in declared:
            raise unknown(f"parameter of {singular(plugin.kind)} {plugin.name}", name, declared)
        checked[name] = check(declared[name], value, f"{plugin.name}.{name}")
    try:
        return plugin(**checked)
    except (UserError, KeyboardInterrupt):
        raise
    except BaseException as error:
        reason = f"{type(error).__name__}: {printable(error)[:300]}"
        raise UserError(
            f"{singular(plugin.kind)} '{plugin.name}' cannot be built with these parameters: {reason}"
        ) from None


def singular(kind: str) -> str:
    """Return the axis name of a kind: ``scene`` for ``scenes``, ``study`` for ``studies``.

    >>> singular("scenes"), singular("studies")
    ('scene', 'study')
    """
    return f"{kind.removesuffix('ies')}y" if kind.endswith("ies") else kind.removesuffix("s")


def check(parameter: Parameter, value: Any, where: str) -> Any:
    """Return ``value`` converted to the parameter's type; raises :class:`UserError` for an invalid type or value."""
    kinds = parameter.kinds
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
    """Convert ``value`` to ``kind`` (bool, int, float or str) without loss; raises :class:`UserError` otherwise.

    >>> coerce(int, 3.0, "samples"), coerce(float, "1e3", "stiffness")
    (3, 1000.0)
    """
    # bool is a subclass of int, but true is not a number here
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind is float:
        if isinstance(value, str):
            try:
                value, number = float(value), True
            except ValueError:
                number = False
        if number and abs(value) > sys.float_info.max and value not in (math.inf, -math.inf):
            raise UserError(f"{where} is larger than the largest float, {sys.float_info.max:g}")
        if number and not math.isnan(value):
            return float(value)
    elif kind is int:
        if number and abs(value) <= LARGEST and float(value).is_integer():
            return int(value)
        if number and value == value and abs(value) > LARGEST:
            raise UserError(f"{where} must be a whole number of at most {LARGEST}")
    elif kind is str and isinstance(value, str) and not value.isprintable():
        raise UserError(f"{where}={value[:100]!r} must be a string without control characters")
    elif (kind is bool and isinstance(value, bool)) or (kind is str and isinstance(value, str)):
        return value
    article = {float: "a number", int: "a whole number", bool: "true or false", str: "a string"}.get(kind, str(kind))
    given = "" if number else f", not {type(value).__name__}"
    raise UserError(f"{where}={repr(value)[:200]} must be {article}{given}")
