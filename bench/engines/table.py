"""The table of engines: the conformance set and the experiment ``engine_gradients`` on all that are installed."""

from __future__ import annotations

import csv
import inspect
import json
import os
import subprocess
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from bench.engines import environments
from bench.engines.backend import EngineBackend
from bench.engines.conformance import runner
from bench.errors import printable
from bench.model import registry

COLUMNS = (
    "engine", "versions", "case", "term", "is_right", "digits", "looks_like", "against", "seconds", "reason", "command",
)  # fmt: skip
LIMIT_S = 3600.0
"""Seconds allowed for an engine's conformance set."""
GRADIENTS = "engine_gradients"
"""The experiment whose table is on the page too."""


def write(names: Collection[str], out: Path, settings: Sequence[str] = ()) -> Path:
    """Write ``engines.csv`` and ``engines.md`` of the named engines, or of all; returns the page's path.

    An engine runs the conformance set if there is a file ``engines/NAME_conformance.py`` beside the folder of its
    backend. ``settings`` are the experiment's.
    """
    rows: list[dict[str, Any]] = []
    usable = []
    for name, entry in registry.entries()["backends"].items():
        if entry.plugin is None or (names and name not in names):
            continue
        file = Path(inspect.getfile(entry.plugin)).parents[1] / "engines" / f"{name}_conformance.py"
        if not (issubclass(entry.plugin, EngineBackend) or file.exists()):
            continue
        backend = entry.plugin()
        reason = entry.reason or backend.unavailable_reason()
        if not reason:
            usable.append(name)
            rows += _conformance(name, backend, file)
        else:
            rows.append({"engine": name, "reason": reason})
    out.mkdir(parents=True, exist_ok=True)
    with (out / "engines.csv").open("w", newline="") as table:
        writer = csv.DictWriter(table, COLUMNS)
        writer.writeheader()
        writer.writerows({**row, "command": _command(row["engine"])} for row in rows)
    words = [f"+experiment={GRADIENTS}", f"backends=[{','.join(usable)}]", f"results_dir={out}", *settings]
    subprocess.run([sys.executable, "-m", "bench", *words], check=False)
    gradients = out / GRADIENTS / "engines.md"
    page = out / "engines.md"
    page.write_text(_page(rows) + (f"\n{gradients.read_text()}" if gradients.exists() else ""))
    return page


def _command(engine: str) -> str:
    return f"python -m bench engines table {engine}"


def _conformance(name: str, backend: Any, file: Path) -> list[dict[str, Any]]:
    """Return the rows of an engine in the conformance set, run in its own Python."""
    if not file.exists():
        return [{"engine": name, "reason": f"no file {file.name} for the conformance set"}]
    python, environment = sys.executable, {**os.environ, "PYTHONPATH": str(Path(runner.__file__).parents[3])}
    if isinstance(backend, EngineBackend):
        python, environment = backend.python or str(environments.python_of(name)), dict(os.environ)
    words = [python, runner.__file__, str(file)]
    try:
        done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=LIMIT_S)
        result = json.loads(done.stdout.splitlines()[-1])
    except (OSError, subprocess.TimeoutExpired, IndexError, ValueError) as error:
        return [{"engine": name, "reason": f"the conformance set failed ({printable(error)[:200]})"}]
    versions = "; ".join(f"{library} {version}" for library, version in result["versions"].items())
    return [{"engine": name, "versions": versions, **row} for row in result["rows"]]


def _page(rows: list[dict[str, Any]]) -> str:
    """Return the page: versions and commands by engine, then digits by case and engine, the worst term's, with its fault."""
    engines = list(dict.fromkeys(row["engine"] for row in rows))
    lines = [
        "# Conformance of physics engines",
        "",
        "| engine | versions | right | not right | command |",
        "|---|---|--:|--:|---|",
    ]
    for engine in engines:
        own = [row for row in rows if row["engine"] == engine]
        state = next((row["versions"] for row in own if row.get("versions")), own[0].get("reason", ""))
        counts = [sum(row.get("is_right") is verdict for row in own) for verdict in (True, False)]
        lines.append(f"| {engine} | {printable(state)} | {counts[0]} | {counts[1]} | `{_command(engine)}` |")
    run = [engine for engine in engines if any("case" in row for row in rows if row["engine"] == engine)]
    lines += ["", f"| case | {' | '.join(run)} |", f"|---|{'---|' * len(run)}"]
    for case in sorted({row["case"] for row in rows if "case" in row}):
        cells = [_cell([row for row in rows if row.get("case") == case and row["engine"] == engine]) for engine in run]
        lines.append(f"| {case} | {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def _cell(rows: list[dict[str, Any]]) -> str:
    """Return the fewest digits of a case's terms, which terms are wrong, and the fault that they look like."""
    judged = [row for row in rows if row["is_right"] is not None]
    if not judged:
        return rows[0]["reason"] or "cannot tell"
    wrong = [row for row in judged if not row["is_right"]]
    faults = {row["looks_like"] for row in wrong} - {""}
    words = f"wrong: {', '.join(row['term'] for row in wrong)}" + (f" ({'; '.join(sorted(faults))})" if faults else "")
    digits = f"{min(row['digits'] or 0.0 for row in judged):.1f}"
    own = ", own differences" if judged[0]["against"] != "the set" else ""
    return f"{digits} {words if wrong else own}".strip().replace(" ,", ",")
