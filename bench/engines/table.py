"""The table of engines: the conformance set and the experiment ``engine_gradients`` on all that are installed."""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

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
        usable += [] if reason else [name]
        own = [{"reason": reason}] if reason else conformance_rows(name, backend, file)
        rows += [{**row, "engine": name, "command": f"python -m bench engines table {name}"} for row in own]
    out.mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    table.to_csv(out / "engines.csv", index=False)
    words = [f"+experiment={GRADIENTS}", f"backends=[{','.join(usable)}]", f"results_dir={out}", *settings]
    subprocess.run([sys.executable, "-m", "bench", *words], check=False)
    gradients = out / GRADIENTS / "engines.md"
    page = out / "engines.md"
    page.write_text(_page(table) + (f"\n{gradients.read_text()}" if gradients.exists() else ""))
    return page


def conformance_rows(name: str, backend: Any, file: Path, *cases: str) -> list[dict[str, Any]]:
    """Return the rows of an engine in the named cases of the conformance set, or all, run in its own Python."""
    if not file.exists():
        return [{"reason": f"no file {file.name} for the conformance set"}]
    python, environment = sys.executable, {**os.environ, "PYTHONPATH": str(Path(runner.__file__).parents[3])}
    if isinstance(backend, EngineBackend):
        python, environment = backend.python or str(environments.python_of(name)), dict(os.environ)
    words = [python, runner.__file__, str(file), *cases]
    try:
        done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=LIMIT_S)
        result = json.loads(done.stdout.splitlines()[-1])
    except (OSError, subprocess.TimeoutExpired, IndexError, ValueError) as error:
        return [{"reason": f"the conformance set failed ({printable(error)[:200]})"}]
    versions = "; ".join(f"{library} {version}" for library, version in result["versions"].items())
    return [{"versions": versions, **row} for row in result["rows"]]


def _page(table: pd.DataFrame) -> str:
    """Return the page: a line per engine, a table of cases by engines, and the reasons for what is missing in it."""
    table = table.fillna("")
    engines = [
        [name, own["versions"].max(), *((own["is_right"] == verdict).sum() for verdict in (True, False)),
         f"{own[own['seconds'] != ''].drop_duplicates('case')['seconds'].sum():.1f}", f"`{own['command'].iloc[0]}`"]
        for name, own in table.groupby("engine", sort=False)
    ]  # fmt: skip
    run = table[table["case"] != ""]
    cells = {key: _cell(rows) for key, rows in run.groupby(["case", "engine"])}
    columns = run["engine"].unique()
    cases = [[case, *(cells.get((case, name), "") for name in columns)] for case in sorted(run["case"].unique())]
    reasons = table[table["reason"] != ""].drop_duplicates(["engine", "case"]).groupby(["engine", "reason"])["case"]
    notes = [f"- {name}, {', '.join(filter(None, of)) or 'all'}: {printable(why)[:160]}" for (name, why), of in reasons]
    return "\n".join([
        "# Conformance of physics engines", "",
        *_markdown(["engine", "versions", "right", "not right", "seconds", "command"], engines), "",
        "The fewest digits of a case's derivatives. own: compared with the engine's own differences. -: not run. ?: cannot tell.", "",
        *_markdown(["case", *columns], cases), "", *notes, "",
    ])  # fmt: skip


def _markdown(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    return [f"| {' | '.join(map(str, row))} |" for row in (heads, ["---"] * len(heads), *rows)]


def _cell(rows: pd.DataFrame) -> str:
    """Return the fewest digits of a case's terms, which terms are wrong, and the faults that they look like."""
    judged = rows[rows["is_right"] != ""]
    digits = judged["digits"][judged["digits"] != ""]
    if judged.empty:
        return "?" if (rows["digits"] != "").any() else "-"
    if digits.empty:
        return "error"
    wrong = judged[judged["is_right"] == False]  # noqa: E712
    faults = sorted({*wrong["looks_like"]} - {""})
    words = [f"{digits.min():.1f}", "own" if "own differences" in {*judged["against"]} else ""]
    words += [f"wrong: {', '.join(wrong['term'])}"] * (not wrong.empty) + [f"({'; '.join(faults)})"] * bool(faults)
    return " ".join(filter(None, words))
