"""Short labels for long identity strings, with a key."""

from __future__ import annotations

import re
from itertools import count, product
from string import ascii_lowercase

LONGEST = 24
"""Longest identity string, in characters, that is shown in full."""
IDENTITY = re.compile(r"[\w.+-]+\[([^\[\]]*=[^\[\]]*)\]")
"""A name with parameters in brackets. A letter in brackets has no ``=``, so it cannot be mistaken for a parameter."""


class Labels:
    """Replaces the parameters of each long identity string by one letter; :attr:`key` has the parameters of each letter.

    >>> labels = Labels()
    >>> labels.short("alpha_order[delta=0.95,gamma=4,sharing=shared]"), labels.short("fobg"), labels.key
    ('alpha_order[a]', 'fobg', ['[a] delta=0.95, gamma=4, sharing=shared'])
    """

    def __init__(self, longest: int = LONGEST) -> None:
        self._longest = longest
        self._letters: dict[str, str] = {}
        self._unused = ("".join(parts) for n in count(1) for parts in product(ascii_lowercase, repeat=n))

    def short(self, text: str) -> str:
        """Return text in which equal parameters of long identity strings have the same letter."""
        return IDENTITY.sub(self._replace, text)

    def _replace(self, match: re.Match[str]) -> str:
        if len(match[0]) <= self._longest:
            return match[0]
        if match[1] not in self._letters:
            self._letters[match[1]] = next(self._unused)
        return match[0].replace(match[1], self._letters[match[1]])

    @property
    def key(self) -> list[str]:
        """Each letter that :meth:`short` has used, with its parameters."""
        return [f"[{letter}] {', '.join(values.split(','))}" for values, letter in self._letters.items()]
