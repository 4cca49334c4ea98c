"""``python -m bench bench-self``: the speed of the harness itself, beside a NumPy loop and native code, in one run."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.benchself import harness, lines, rollouts, sweep
from bench.errors import UserError
from bench.experiment.config import config_dir


def main(words: Sequence[str]) -> int:
    """Measure, write and print; ``quick=true`` makes the run small, ``results_dir=`` chooses the output folder."""
    given = dict(word.partition("=")[::2] for word in words)
    for name in given:
        if name not in ("quick", "results_dir"):
            raise UserError(f"bench-self takes quick=true|false and results_dir=FOLDER, not '{name}'")
    if given.get("quick", "false") not in ("true", "false"):
        raise UserError(f"quick={given['quick']} must be true or false")
    quick = given.get("quick") == "true"
    before = list(os.getloadavg()) if hasattr(os, "getloadavg") else None
    found = []
    for line in measure(quick):
        print(f"{line.what}: {line.value:.3g} {line.unit}", file=sys.stderr, flush=True)
        found.append(line)
    paths = lines.write(found, Path(given.get("results_dir", "results")).expanduser() / "bench_self", before)
    lines.show(found)
    for path in paths:
        print(f"  {path}")
    return 0


def measure(quick: bool) -> Iterator[lines.SpeedRow]:
    """Return all lines, one after the other."""
    import yaml

    settings = yaml.safe_load((config_dir() / "bench_self.yaml").read_text())
    yield from rollouts.backends(settings, quick)
    yield from rollouts.references(settings, quick)
    yield from rollouts.compared(settings, quick)
    yield from sweep.lines(settings)
    yield from harness.lines(quick)
