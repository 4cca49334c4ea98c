"""Prepares command-line words for Hydra, and checks experiment files; errors name the word or the file."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from bench.errors import UserError, printable
from bench.experiment.grid import MAX_CELLS
from bench.host.identity import split_items

GLOBAL = "# @package _global_"
"""The first line of an experiment file, so that Hydra does not nest its settings."""
MAPPINGS = ("sweep", "marks", "compares", "reference")
"""Settings that are tables; the parameters of plugins are too."""
LISTS_AS = "write key=value with lists as [a,b] and strings in quotes"


Override = tuple[list[str], Any]
"""The keys of a setting, from the outermost, and its value."""


def names_of(value: str) -> list[str]:
    """Return the names of a value that is one name or a list, as the shell leaves it.

    >>> names_of("fobg"), names_of("[fobg,'reinforce[baseline=none]']")
    (['fobg'], ['fobg', 'reinforce[baseline=none]'])
    """
    inner = value[1:-1] if value.startswith("[") and value.endswith("]") else value
    return [name for item in split_items(inner) if (name := item.strip().strip("'\""))]


def quoted(value: str) -> str:
    """Return a value in quotes if it has characters that Hydra reads in quotes only, such as é; else unchanged.

    >>> quoted("results"), quoted("résultats"), quoted("'résultats'"), quoted("[é]")
    ('results', "'résultats'", "'résultats'", '[é]')
    """
    if value.isascii() or not value.isprintable() or any(character in value for character in "'\"[]{}"):
        return value
    return "'" + value + ("\\" if value.endswith("\\") else "") + "'"


def with_ranges(key: str, value: str) -> str:
    """Return the value of a setting with ranges in a sweep written out.

    >>> with_ranges("sweep.seed", "range(0,6,2)")
    '[0,2,4]'
    """
    if key.partition(".")[0] not in ("sweep", "theta0") or "'" in value or '"' in value:
        return value
    return re.sub(r"range\(([^()]*)\)", lambda match: f"[{','.join(map(str, _range(key, match)))}]", value)


def _range(key: str, match: re.Match[str]) -> range:
    try:
        numbers = range(*(int(part) for part in match[1].split(",")))
    except (ValueError, TypeError):
        raise UserError(
            f"{key}={match[0]} is not a range: write range(start,stop) or range(start,stop,step) with whole numbers; "
            "stop itself is left out"
        ) from None
    if len(numbers) > MAX_CELLS:
        raise UserError(f"{key}={match[0]} has {len(numbers)} values, and more than {MAX_CELLS} are not allowed")
    return numbers


def parse(given: str, word: str) -> Override:
    """Return the keys and the value of an override in Hydra's syntax; ``given`` is the user's, which errors name.

    A list that is JSON, which may be long, is read without Hydra's grammar: that takes a millisecond per number.
    """
    key, _, value = word.partition("=")
    if value.startswith("[") and "\\" not in value:
        with suppress(ValueError, RecursionError):
            return key.split("."), json.loads(value)
    try:
        from hydra.core.override_parser.overrides_parser import OverridesParser

        override = OverridesParser.create().parse_override(word)
        if override.package is None and not override.is_sweep_override():
            return override.key_or_group.split("."), override.value()
    except ModuleNotFoundError:
        raise
    except Exception:  # Hydra's of many types; ValueError for a number of 5000 digits, RecursionError
        pass
    raise UserError(f"'{given[:200]}' cannot be read: {LISTS_AS}") from None


def merge(settings: dict[str, Any], keys: Sequence[str], value: Any) -> None:
    """Put a value into nested settings in place: a table is merged into the present one, anything else replaces it."""
    *above, last = keys
    for key in above:
        if not isinstance(settings.get(key), dict):
            settings[key] = {}
        settings = settings[key]
    if isinstance(value, dict) and isinstance(settings.get(last), dict):
        for key, part in value.items():
            merge(settings[last], [key], part)
    else:
        settings[last] = value


def check_file(path: Path) -> dict[str, Any]:
    """Return the content of an experiment file; raises :class:`UserError` with the file and the line if it cannot be read."""
    import yaml
    from omegaconf import OmegaConf

    try:
        text = path.read_bytes().decode()
        for event in yaml.parse(text):
            if isinstance(event, yaml.AliasEvent):  # a few lines of aliases may stand for more values than memory holds
                raise ValueError(
                    f"line {event.start_mark.line + 1}: *{event.anchor} is an alias: write the value itself"
                )
        content = OmegaConf.to_container(OmegaConf.load(path), resolve=False) if text.strip() else {}
    except Exception as error:  # of the file, of YAML, and OmegaConf's own, such as a key that is a list
        raise UserError(f"'{path}' cannot be read: {printable(error)[:400]}") from None
    _check_content(path, text, content)
    return dict(content)  # type: ignore[arg-type]


def _check_content(path: Path, text: str, content: Any) -> None:
    if not isinstance(content, dict):
        raise UserError(f"'{path}' must be a table of settings, key: value, and is {type(content).__name__}")
    first = next((line for line in text.lstrip("\ufeff").splitlines() if line.strip()), "")
    if first.split() != GLOBAL.split():
        raise UserError(f"'{path}' must start with the line {GLOBAL}")
    for key, value in content.items():
        line = next((n for n, row in enumerate(text.splitlines(), 1) if row.startswith(f"{key}:")), 0)
        where = f"'{path}'" + (f", line {line}" if line else "")
        if not isinstance(key, str):
            raise UserError(f"{where}: {key!r} is not a setting: settings are names")
        if key in MAPPINGS and value is not None and not isinstance(value, dict):
            raise UserError(f"{where}: {key} must be a table, and is {repr(value)[:100]}: write {key}: {{name: value}}")
