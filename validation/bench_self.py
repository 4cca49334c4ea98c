"""Measures the speed of the harness, compared with a NumPy loop and native code.

``python validation/bench_self.py [quick=true] [results_dir=DIR]`` writes ``results_dir/bench_self/``; quick=true runs small
sizes.
"""

import os
import sys
from pathlib import Path

from speed import compilations, harness, rollouts, speed_rows

from bench.errors import UserError
from bench.experiment.config import config_dir
from bench.experiment.words import parse_flag, parse_words


def main(words):
    """Measure and print speeds, and write them. Returns 0. ``quick=true`` runs small sizes."""
    names, settings, _ = parse_words(words, "bench_self", {"quick": "false", "results_dir": "results"})
    if names:
        raise UserError(f"bench_self takes quick=true|false and results_dir=FOLDER, not '{names[0]}'")
    load_before = list(os.getloadavg()) if hasattr(os, "getloadavg") else None
    rows = []
    for row in measure(parse_flag(settings, "quick")):
        print(f"{row.what}: {row.value:.3g} {row.unit}{row.note and f' ({row.note})'}", flush=True)
        rows.append(row)
    print(speed_rows.write(rows, Path(settings["results_dir"]).expanduser() / "bench_self", load_before))
    return 0


def measure(quick):
    """Measure and yield every row of the table."""
    import yaml

    settings = yaml.safe_load((config_dir() / "bench_self.yaml").read_text())
    yield from rollouts.measure_backends(settings, quick)
    yield from rollouts.measure_baselines(settings, quick)
    yield from rollouts.compare_backends(settings, quick)
    yield from compilations.count_compilations(settings)
    yield from harness.measure_commands(quick)


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except UserError as error:
        sys.exit(f"bench_self: {error}")
