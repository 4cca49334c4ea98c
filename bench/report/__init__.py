"""Rows in, files out: tables, charts and the record of a run. Knows no plugin."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench import timing
from bench.store import IDENTITY, write_whole

if TYPE_CHECKING:
    import pandas as pd

    from bench.grid import Experiment

LIBRARIES = ("numpy", "scipy", "jax", "jaxlib", "torch", "optimistix", "lineax", "hydra-core", "pandas", "pyarrow")


def latest(rows: pd.DataFrame) -> pd.DataFrame:
    """The newest row of each cell, when editing a plugin has left rows of older versions behind."""
    return rows.drop_duplicates(list(IDENTITY), keep="last").reset_index(drop=True)


def record(experiment: Experiment, rows: pd.DataFrame, words: list[str], seconds: float, simulated: bool) -> Path:
    """Write ``run.json``: what was run, with what, on what, and how it ended.

    A run that found all its rows stored leaves what the last one that simulated the same has written.
    """
    content: dict[str, Any] = {
        "command": " ".join(["python -m bench", *words]),
        "experiment": experiment.name,
        "study": experiment.study,
        "question": experiment.question,
        "config": {
            **{kind: [_identity(c) for c in chosen] for kind, chosen in experiment.choices.items()},
            "sweep": experiment.sweep,
            **{group: values for group, values in experiment.values.items() if values},
            "samples": experiment.samples,
            "repeats": experiment.repeats,
            "seed": experiment.seed,
            "reference": {"samples": experiment.reference_samples, "tolerance": experiment.reference_tolerance},
        },
        "seeds": sorted({int(seed) for seed in rows["seed"]}),
        "counts": {str(k): int(v) for k, v in rows["status"].value_counts().items()},
        "duration_s": round(seconds, 3),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in LIBRARIES},
        **_compilations(rows),
        "machine": {**machine(), "load_average_start": timing.load_at_start()},
        "git_commit": _commit(),
        "argv": [Path(sys.argv[0]).name, *words],
    }
    path = experiment.directory / "run.json"
    text = json.dumps(content, indent=1, default=str) + "\n"
    if simulated or _is_other(path, json.loads(text)):
        write_whole(path, text.encode())
    return path


def _is_other(path: Path, made: dict[str, Any]) -> bool:
    """Whether a record is of another configuration, or is none."""
    try:
        return bool(json.loads(path.read_text())["config"] != made["config"])
    except (OSError, ValueError, TypeError, KeyError):
        return True


def _identity(choice: Any) -> str:
    values = ",".join(f"{k}={v}" for k, v in choice.values)
    return f"{choice.entry.name}[{values}]" if values else choice.entry.name


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def machine() -> dict[str, Any]:
    """The system, and what times on it depend on."""
    return {"system": platform.system(), **timing.conditions()}


def _compilations(rows: pd.DataFrame) -> dict[str, int]:
    """Compilations that the rows took, and the distinct program structures, functions and shapes among them."""
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
