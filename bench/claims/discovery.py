"""Finds claims through the plugin registry, and sorts them by lesson."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

from bench.claims.claim import Claim
from bench.errors import printable, unknown
from bench.model import registry

LESSONS = {
    "Low variance is not low bias": "The spread of a gradient says nothing about its distance from the truth.",
    "Which variance is smaller": "Roughness costs the first order, dimension the zeroth.",
    "Stiffness or step size": "Much of what is blamed on stiff contact is the time step's.",
    "Time of impact": "A motion that is nearly right can have a derivative of the wrong sign.",
    "The price of smoothing": "Smoothing lets a gradient see past an edge, and moves the optimum.",
    "Chaos": "Beyond the horizon of chaos derivatives are right and useless.",
    "Windows and objectives": "Shorter problems have tamer gradients, of another objective.",
}
"""The lessons in order, each with a summary of one sentence. Claims of other packages may add lessons."""


def claims() -> dict[str, type[Claim]]:
    """Return all claims by name, sorted by lesson. A plugin that cannot be used is reported on stderr."""
    entries = registry.entries_with("claims").values()
    others = (entry for kind, table in registry.entries().items() if kind != "claims" for entry in table.values())
    for entry in (*entries, *others):
        if entry.plugin is None:
            print(f"bench: '{printable(entry.name)}' cannot be used: {printable(entry.reason)}", file=sys.stderr)
    complete: list[type[Claim]] = []
    for entry in entries:
        if entry.plugin is not None and issubclass(entry.plugin, Claim):
            required = ("lesson", "statement", "source", "learned")
            missing = [name for name in required if not isinstance(getattr(entry.plugin, name, None), str)]
            if missing:
                print(f"bench: claim '{entry.name}' does not define {', '.join(missing)}", file=sys.stderr)
            else:
                complete.append(entry.plugin)
    return {claim.name: claim for claim in sorted(complete, key=_position)}


def _position(claim: type[Claim]) -> tuple[int, str, str, int]:
    """Return the sorting key of a claim: its lesson, then the letters and the number of its name."""
    lessons = list(LESSONS)
    lesson = lessons.index(claim.lesson) if claim.lesson in lessons else len(lessons)
    letters = claim.name.rstrip("0123456789")
    return lesson, claim.lesson, letters, int(claim.name[len(letters) :] or 0)


def select(claims: Mapping[str, type[Claim]], names: Sequence[str], quick: bool) -> list[type[Claim]]:
    """Return the named claims, or all if ``names`` is empty; with ``quick``, only the quick claims among them.

    Names are case-insensitive. Raises :class:`UserError` for an unknown name.
    """
    by_lower = {name.lower(): name for name in claims}
    for name in names:
        if name.lower() not in by_lower:
            raise unknown("claim", name, claims)
    selected = {by_lower[name.lower()] for name in names} or set(claims)
    return [claim for name, claim in claims.items() if name in selected and (claim.quick or not quick)]
