"""``python -m bench claims``: published results about gradients through simulators, run again, each with a verdict."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from bench.claims.claim import NOT_REPRODUCED, Claim, Figure, Outcome
from bench.errors import UserError, printable

__all__ = ["Claim", "Figure", "Outcome", "main"]

OPTIONS = ("--list", "--quick", "--again")


def main(words: Sequence[str]) -> int:
    """Run the claims named, or all; returns 1 where one is not reproduced or its code fails."""
    from bench.claims import results, shelf, tables
    from bench.sweep.files import make_directory

    names = [word for word in words if not word.startswith("-") and "=" not in word]
    directory = Path("results")
    for word in words:
        key, equals, value = word.partition("=")
        if equals and key == "results_dir" and value:
            directory = Path(value).expanduser()
        elif word not in OPTIONS and word not in names:
            raise UserError(f"claims takes names, {', '.join(OPTIONS)} and results_dir=FOLDER, not '{word}'")
    claims = shelf.chosen(names, "--quick" in words)
    if "--list" in words:
        for line in tables.listed(claims):
            print(printable(line) if not line.startswith("  ") else f"  {printable(line)}")
        return 0
    directory = directory / "claims"
    make_directory(directory)
    bad = False
    for claim in claims:
        result = None if "--again" in words else results.stored(directory, claim)
        fresh = result is None
        if result is None:
            print(f"{claim.name} ...", file=sys.stderr, flush=True)
            result = results.measured(claim)
            results.keep(directory, result)
        for line in tables.lines(claim, result, fresh):
            print(line, flush=True)
        bad = bad or result.verdict in (NOT_REPRODUCED, results.FAILED)
    # the page has all that is stored, also of claims that this command did not name
    everything = [(claim, results.stored(directory, claim)) for claim in shelf.claims().values()]
    found = [(claim, result) for claim, result in everything if result is not None]
    if found:
        for path in tables.write(directory, found)[-4:]:
            print(f"  {path}")
        print(f"{len(found)} claims: {tables.counts(found)}")
    return 1 if bad else 0
