"""Plugins as strings or JSON: short identity strings for people, and all parameters for programs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bench.errors import UserError, printable
from bench.host.parameters import Plugin, parameters, values


def identity(name: str, given: Mapping[str, Any]) -> str:
    """Return the identity string of a plugin name and parameter values; only the name if ``given`` is empty.

    >>> identity("alpha_order", {"gamma": 0.01, "delta": 0.1})
    'alpha_order[delta=0.1,gamma=0.01]'
    """
    text = ",".join(f"{key}={text_of(given[key])}" for key in sorted(given))
    return f"{name}[{text}]" if text else name


def text_of(value: Any) -> str:
    """Return a parameter value in command-line syntax.

    >>> [text_of(value) for value in (None, True, 0.5, 1e6, 10.0)]
    ['null', 'true', '0.5', '1e+06', '10']
    """
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and value.is_integer() and float(f"{value:g}") == value:
        return f"{value:g}"
    return str(value)


def parse_identity(text: str) -> tuple[str, dict[str, Any]]:
    """Return the name and the unvalidated values of an identity string; raises :class:`UserError` if malformed."""
    import yaml

    name, bracket, rest = str(text).partition("[")
    raw: dict[str, Any] = {}
    if bracket:
        if not rest.endswith("]"):
            raise UserError(f"'{text}' is not a plugin: write name or name[parameter=value,...]")
        for item in filter(None, split_items(rest[:-1])):
            key, equals, value = item.partition("=")
            if not equals:
                raise UserError(f"'{item}' in '{text}' is not parameter=value")
            if key.strip() in raw:
                raise UserError(f"'{key.strip()}' has two values in '{printable(text)[:200]}'")
            try:
                raw[key.strip()] = value if value.startswith("{") else yaml.safe_load(value)
            except (yaml.YAMLError, ValueError, RecursionError):  # ValueError: an invalid date
                raise UserError(
                    f"'{value}' in '{printable(text)[:200]}' is not a value: write parameter=value"
                ) from None
    return name.strip(), raw


def split_items(text: str) -> list[str]:
    """Return the parts of a text between commas that are in no brackets.

    >>> split_items("horizon=50,policy=mlp[hidden=8,scale=1]")
    ['horizon=50', 'policy=mlp[hidden=8,scale=1]']
    """
    parts, depth = [""], 0
    for character in text:
        depth += {"[": 1, "{": 1, "]": -1, "}": -1}.get(character, 0)
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return parts


def changed(plugin: Plugin) -> dict[str, Any]:
    """Return the parameter values that differ from the defaults."""
    return {
        name: getattr(plugin, name)
        for name, parameter in parameters(type(plugin)).items()
        if getattr(plugin, name) != parameter.default
    }


def label(plugin: Plugin) -> str:
    """Return a plugin's identity string, omitting unchanged parameters."""
    return identity(plugin.name, changed(plugin))


def described(plugin: Plugin | None) -> dict[str, Any] | None:
    """Return a plugin's name and all parameters for strict JSON, with infinities as strings; None for None."""
    if plugin is None:
        return None
    return {"name": plugin.name} | {name: plain(value) for name, value in values(plugin).items()}


def plain(value: Any) -> Any:
    """Return a parameter's value for strict JSON: infinities as strings, tuples as lists."""
    if isinstance(value, tuple):
        return list(value)
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
