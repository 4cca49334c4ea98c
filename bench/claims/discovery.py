"""Finds claims: the files of ``bench/claims/published``, and the entry points of other packages."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import sys
from collections.abc import Sequence
from functools import cache
from importlib.metadata import entry_points

from bench.claims import published
from bench.claims.claim import Claim
from bench.errors import UserError, printable, unknown

ENTRY_POINT_GROUP = "bench.claims"
"""Each entry point names a :class:`~bench.claims.claim.Claim` class, or a module that holds some."""
LESSONS = {
    "Low variance is not low bias": "The spread of a gradient says nothing about its distance from the truth.",
    "Which variance is smaller": "Roughness costs the first order, dimension the zeroth.",
    "Stiffness or step size": "Much of what is blamed on stiff contact is the time step's.",
    "Time of impact": "A motion that is nearly right can have a derivative of the wrong sign.",
    "The price of smoothing": "Smoothing lets a gradient see past an edge, and moves the optimum.",
    "Chaos": "Beyond the horizon of chaos derivatives are right and useless.",
    "Windows and objectives": "Shorter problems have tamer gradients, of another objective.",
}
"""The lessons in the order of the course, each in a sentence. Claims of other packages may bring their own."""


@cache
def claims() -> dict[str, type[Claim]]:
    """Return all claims by name, in the order of the course; raises :class:`UserError` for a name used twice."""
    modules = [f"{published.__name__}.{module.name}" for module in pkgutil.iter_modules(published.__path__)]
    found = [claim for module in modules for claim in _of(importlib.import_module(module))]
    for point in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda point: point.name):
        try:
            found += _of(point.load())
        except Exception as error:
            # one broken package must not hide the claims of the others
            said = f"{type(error).__name__}: {error}"
            print(f"bench: claims of entry point '{point.name}' cannot be used: {printable(said)}", file=sys.stderr)
    table: dict[str, type[Claim]] = {}
    for claim in sorted(found, key=_place):
        if claim.name in table:
            raise UserError(f"two claims are called '{claim.name}': {table[claim.name].__module__}, {claim.__module__}")
        table[claim.name] = claim
    return table


def _of(thing: object) -> list[type[Claim]]:
    """Return the claims of a module, or the claim itself."""
    if inspect.isclass(thing):
        if not issubclass(thing, Claim):
            raise UserError(f"entry point of group {ENTRY_POINT_GROUP} names {thing.__qualname__}, which is no Claim")
        return [thing]
    own = (value for value in vars(thing).values() if inspect.isclass(value) and issubclass(value, Claim))
    name = getattr(thing, "__name__", "")
    return [claim for claim in own if not inspect.isabstract(claim) and claim.__module__ == name]


def _place(claim: type[Claim]) -> tuple[int, str, int]:
    lessons = list(LESSONS)
    place = lessons.index(claim.lesson) if claim.lesson in lessons else len(lessons)
    letters, number = re.match(r"(\D*)(\d*)", claim.name).groups()  # type: ignore[union-attr]
    return place, letters, int(number or 0)


def chosen(names: Sequence[str], quick: bool) -> list[type[Claim]]:
    """Return the claims of these names, or all; raises :class:`UserError` for one that does not exist."""
    table = claims()
    by_lower = {name.lower(): name for name in table}
    for name in names:
        if name.lower() not in by_lower:
            raise unknown("claim", name, table)
    wanted = {by_lower[name.lower()] for name in names} or set(table)
    return [claim for name, claim in table.items() if name in wanted and (claim.quick or not quick)]
