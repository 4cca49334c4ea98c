"""``python -m bench claims``: repeats published results on gradients through simulators, with a verdict on each."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from bench.claims.claim import NOT_REPRODUCED, Claim, Figure, Outcome
from bench.errors import local_path

__all__ = ["Claim", "Figure", "Outcome", "main"]


def main(words: Sequence[str]) -> int:
    """Run the named claims, or all, and print verdicts. Returns 1 if a claim is not reproduced or its code fails."""
    from bench.claims import discovery, page, results, tables
    from bench.experiment.words import parse_words
    from bench.run.files import make_directory

    known = {"results_dir": "results"}
    names, settings, options = parse_words(words, "claims", known, ("--list", "--quick", "--again"))
    claims = discovery.claims()
    selected = discovery.select(claims, names, "--quick" in options)
    if "--list" in options:
        print("\n".join(tables.list_lines(selected)))
        return 0
    directory = local_path("results_dir", settings["results_dir"]) / "claims"
    make_directory(directory)
    # the page also shows stored results of claims that this command does not name
    by_name = {name: results.read(directory, claim) for name, claim in claims.items()}
    for claim in selected:
        result = None if "--again" in options else by_name[claim.name]
        is_stored = result is not None
        if result is None:
            print(f"{claim.name} ...", file=sys.stderr, flush=True)
            result = by_name[claim.name] = results.measure(claim)
            results.store(directory, result)
        print("\n".join(tables.result_lines(claim, result, is_stored)), flush=True)
    shown = [(claims[name], result) for name, result in by_name.items() if result is not None]
    if shown:
        for path in page.write(directory, shown):
            print(f"  {path}")
        print(tables.count_verdicts(shown))
    bad = (NOT_REPRODUCED, results.FAILED)
    return int(any(result.verdict in bad for claim, result in shown if claim in selected))
