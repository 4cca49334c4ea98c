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
    from bench.claims import discovery, results, tables
    from bench.report.text import counted
    from bench.run.files import make_directory

    names = [word for word in words if not word.startswith("-") and "=" not in word]
    directory = Path("results")
    for word in words:
        key, equals, value = word.partition("=")
        if equals and key == "results_dir" and value:
            directory = Path(value).expanduser()
        elif word not in OPTIONS and word not in names:
            raise UserError(f"claims takes names, {', '.join(OPTIONS)} and results_dir=FOLDER, not '{word}'")
    claims = discovery.chosen(names, "--quick" in words)
    if "--list" in words:
        for line in tables.listed(claims):
            print(printable(line) if not line.startswith("  ") else f"  {printable(line)}")
        return 0
    directory = directory / "claims"
    make_directory(directory)
    found = {claim.name: results.stored(directory, claim) for claim in discovery.claims().values()}
    for claim in claims:
        result = None if "--again" in words else found[claim.name]
        fresh = result is None
        if result is None:
            print(f"{claim.name} ...", file=sys.stderr, flush=True)
            result = results.measured(claim)
            results.keep(directory, result)
        for line in tables.lines(claim, result, fresh):
            print(line, flush=True)
        found[claim.name] = result
    # the page has all that is stored, also of claims that this command did not name, and what failed just now
    shown = [(claim, result) for claim in discovery.claims().values() if (result := found[claim.name]) is not None]
    if shown:
        for path in tables.write(directory, shown)[-4:]:
            print(f"  {path}")
        print(f"{counted(len(shown), 'claim')}: {tables.counts(shown)}")
    asked = {claim.name for claim in claims}
    bad = (NOT_REPRODUCED, results.FAILED)
    return int(any(result.verdict in bad for claim, result in shown if claim.name in asked))
