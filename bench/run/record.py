"""Writes ``run.json``, the record of a run, and identifies the kind of this machine."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.errors import printable
from bench.experiment.experiment import Experiment
from bench.host.parameters import remember
from bench.measure import timing
from bench.run.files import write_whole
from bench.run.rows import read_record

if TYPE_CHECKING:
    import pandas as pd

LIBRARIES = ("numpy", "scipy", "jax", "jaxlib", "torch", "optimistix", "lineax", "hydra-core", "pandas", "pyarrow")


def record(experiment: Experiment, rows: pd.DataFrame, words: list[str], seconds: float, simulated: bool) -> Path:
    """Write ``run.json``: configuration, versions, machine, counts of rows by status, and duration.

    A run that simulated nothing does not replace a record with the same configuration.
    """
    content: dict[str, Any] = {
        "command": " ".join(["python -m bench", *words]),
        "experiment": experiment.name,
        "study": experiment.study.name,
        "question": experiment.question,
        "config": experiment.record(),
        "seeds": sorted({int(seed) for seed in rows["seed"]}),
        "counts": {str(k): int(v) for k, v in rows["status"].value_counts().items()},
        "duration_s": round(seconds, 3),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "python": platform.python_version(),
        "versions": {name: version_of(name) for name in LIBRARIES},
        **_compilations(rows),
        "machine": {**machine(), "load_average_start": timing.load_at_start()},
        "git_commit": _commit(),
        "argv": [Path(sys.argv[0]).name, *words],
    }
    path = experiment.directory / "run.json"
    text = json.dumps(content, indent=1, default=str) + "\n"
    if simulated or read_record(experiment.directory).get("config") != json.loads(text)["config"]:
        write_whole(path, text.encode())
    return path


def version_of(name: str) -> str | None:
    """Return the version of an installed distribution, or None."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def machine() -> dict[str, Any]:
    """Return the system and the timing conditions: processor, available cores and threads, load."""
    return {"system": platform.system(), **timing.conditions()}


@remember
def kind_of_machine() -> str:
    """Return the kind of this machine: processor, cores and system, no host name. Times of one kind are comparable."""
    facts = timing.conditions()
    n_cores = len(facts["affinity"] or ()) or os.cpu_count() or 1
    return f"{printable(facts['processor']) or platform.machine()}, {n_cores} cores, {platform.system()}"


def _compilations(rows: pd.DataFrame) -> dict[str, int]:
    """Return the numbers of compilations and of distinct compiled structures and shapes in the rows; empty if unknown."""
    if "compilations" not in rows:
        return {}
    shapes = {shape for text in rows["shapes"] for shape in text.split()}
    return {"compilations": int(rows["compilations"].sum()), "distinct_shapes": len(shapes)}


def _commit() -> str | None:
    try:
        where = Path(__file__).resolve().parent
        done = subprocess.run(
            ["git", "-C", str(where), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
