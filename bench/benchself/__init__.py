"""``python -m bench bench-self``: the speed of the harness itself, beside a NumPy loop and native code, in one run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from bench.benchself import harness, lines, rollouts, sweep
from bench.config import config_dir
from bench.errors import UserError


def main(words: Sequence[str]) -> int:
    """Measure, print and write; ``quick=true`` makes it small, ``results_dir=`` says where it writes."""
    given = dict(word.partition("=")[::2] for word in words)
    for name in given:
        if name not in ("quick", "results_dir"):
            raise UserError(f"bench-self takes quick=true|false and results_dir=FOLDER, not '{name}'")
    if given.get("quick", "false") not in ("true", "false"):
        raise UserError(f"quick={given['quick']} must be true or false")
    quick = given.get("quick") == "true"
    before = list(os.getloadavg()) if hasattr(os, "getloadavg") else None
    found = [*measure(quick)]
    lines.show(found)
    for path in lines.write(found, Path(given.get("results_dir", "results")).expanduser() / "bench_self", before):
        print(f"  {path}")
    return 0


def measure(quick: bool) -> list[lines.Line]:
    """All lines, each group told when it is done."""
    import yaml

    settings = yaml.safe_load((config_dir() / "bench_self.yaml").read_text())
    found = [*rollouts.backends(settings, quick), *rollouts.references(settings, quick)]
    return [*found, *sweep.lines(settings), *harness.lines(quick)]
