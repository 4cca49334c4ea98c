"""Parses the command lines of the commands that do not compose an experiment: ``compare``, ``claims``, ``list``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from bench.errors import UserError, unknown
from bench.model import registry


def parse_words(
    words: Sequence[str], command: str, defaults: Mapping[str, str], options: Sequence[str] = ()
) -> tuple[list[str], dict[str, str], set[str]]:
    """Return the names, the settings (``key=value``) and the options (``--quick``) among a command's words.

    ``defaults`` contains every setting of the command with its default. Each command also accepts ``plugins=DIR``,
    which registers the plugins of that folder. Raises :class:`UserError` for an unknown setting or option.
    """
    names, settings, given = [], dict(defaults), set()
    for word in words:
        key, equals, value = word.partition("=")
        if word.startswith("-"):
            if word not in options:
                raise unknown(f"option of {command}", word, options)
            given.add(word)
        elif not equals or "/" in key or "[" in key:
            names.append(word)
        elif key != "plugins" and key not in defaults:
            raise unknown(f"setting of {command}", key, [*defaults, "plugins"])
        elif not value:
            raise UserError(f"{key}= of {command} has no value")
        elif key == "plugins":
            registry.add_folder(Path(value))
        else:
            settings[key] = value
    return names, settings, given
