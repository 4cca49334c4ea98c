"""The table of engines: the conformance set and the experiment ``engine_gradients`` on all that are installed."""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from bench.engines import environments
from bench.engines.backend import EngineBackend
from bench.engines.conformance import runner
from bench.errors import printable
from bench.model import registry

COLUMNS = ("engine", "versions", *runner.COLUMNS, "command")
LIMIT_S = 7200.0
"""Seconds allowed for an engine's conformance set."""
GRADIENTS = "engine_gradients"
"""The experiment whose table is on the page too."""


def write(names: Collection[str], out: Path, settings: Sequence[str] = ()) -> Path:
    """Run the named engines, or all, write ``engines.csv`` and ``engines.md``, and return the page's path.

    An engine runs the conformance set if there is a file ``engines/NAME_conformance.py`` beside the folder of its
    backend. Rows of other engines and of other versions, which ``out`` has already, stay. ``settings`` are the experiment's.
    """
    rows: list[dict[str, Any]] = []
    for name, entry in registry.entries()["backends"].items():
        if entry.plugin is None or (names and name not in names):
            continue
        file = file_of(entry.plugin, "conformance")
        if not (issubclass(entry.plugin, EngineBackend) or file.exists()):
            continue
        backend = entry.plugin()
        reason = entry.reason or backend.unavailable_reason()
        own = [{"reason": reason}] if reason else conformance_rows(name, backend, file)
        rows += [
            {"versions": "", **row, "engine": name, "command": f"python -m bench engines table {name}"} for row in own
        ]
    out.mkdir(parents=True, exist_ok=True)
    table, stored = pd.DataFrame(rows, columns=list(COLUMNS)), out / "engines.csv"
    if stored.exists():
        old = read(stored)
        is_new = old["engine"].isin(table["engine"]) & old["versions"].isin(["", *table["versions"]])
        table = pd.concat([old[~is_new], table]).sort_values(["engine", "versions"], kind="stable")
    table.to_csv(stored, index=False)
    table = read(stored)
    ran = table.loc[table["case"] != "", "engine"].unique()
    words = [f"+experiment={GRADIENTS}", f"backends=[{','.join(ran)}]", f"results_dir={out}", *settings]
    subprocess.run([sys.executable, "-m", "bench", *words], check=False)
    gradients = out / GRADIENTS / "engines.md"
    page = out / "engines.md"
    page.write_text(_page(table) + (f"\n{gradients.read_text()}" if gradients.exists() else ""))
    return page


def file_of(plugin: Any, kind: str) -> Path:
    """Return the file ``engines/NAME_KIND.py`` beside the folder of a backend, which may not exist."""
    return Path(inspect.getfile(plugin)).parents[1] / "engines" / f"{plugin.name}_{kind}.py"


def read(file: Path) -> pd.DataFrame:
    """Return stored rows, all as text."""
    return pd.read_csv(file, dtype=str, keep_default_na=False)


def conformance_rows(name: str, backend: Any, file: Path, *cases: str) -> list[dict[str, Any]]:
    """Return the rows of an engine in the named cases of the conformance set, or all, run in its own Python.

    If the run fails or takes longer than :data:`LIMIT_S`, the last row has the reason.
    """
    return rows_of(name, backend, file, Path(runner.__file__), *cases)


def rows_of(name: str, backend: Any, file: Path, script: Path, *words: str) -> list[dict[str, Any]]:
    """Return the rows of a script of the conformance set on an engine's file, run in the engine's own Python."""
    if not file.exists():
        return [{"reason": f"no file {file.name}"}]
    python, environment = sys.executable, {**os.environ, "PYTHONPATH": str(Path(runner.__file__).parents[3])}
    if isinstance(backend, EngineBackend):
        python, environment = backend.python or str(environments.python_of(name)), dict(os.environ)
    reason = ""
    with tempfile.TemporaryFile("w+") as output:
        try:
            subprocess.run(
                [python, str(script), str(file), *words],
                env=environment, text=True, timeout=LIMIT_S, check=True, stdout=output, stderr=subprocess.PIPE,
            )  # fmt: skip
        except (OSError, subprocess.SubprocessError) as error:
            reason = f"the conformance set stopped: {printable(error)[-80:]} {printable(getattr(error, 'stderr', ''))[-120:]}"
        output.seek(0)
        lines = [json.loads(line) for line in output if line.startswith("{")]
    versions = "; ".join(f"{library} {version}" for library, version in lines[0]["versions"].items()) if lines else ""
    return [{"versions": versions, **row} for row in [*lines[1:], *[{"reason": reason}] * bool(reason)]]


def _page(table: pd.DataFrame) -> str:
    """Return the page: a line per engine, a table of cases by engines, and the reasons for what is missing in it."""
    engines = [
        [name, versions, *((own["is_right"] == verdict).sum() for verdict in ("True", "False")), f"`{own['command'].iloc[0]}`"]
        for (name, versions), own in table.groupby(["engine", "versions"], sort=False)
    ]  # fmt: skip
    told = table[table["reason"] != ""]
    cases = told["case"].str.cat(told["term"].where(told["is_right"] == "False", ""), sep=" ").str.strip()
    reasons = told.assign(case=cases).drop_duplicates(["engine", "case"]).groupby(["engine", "reason"])["case"]
    notes = [f"- {', '.join([name, *filter(None, of)])}: {printable(why)[:160]}" for (name, why), of in reasons]
    return "\n".join([
        "# Conformance of physics engines", "",
        *_markdown(["engine", "versions", "right", "not right", "command"], engines), "",
        "The fewest digits of a case's derivatives. own: compared with the engine's own differences. -: not run. ?: cannot tell.", "",
        *by_case(table), "", *notes, "",
    ])  # fmt: skip


def by_case(table: pd.DataFrame) -> list[str]:
    """Return the Markdown lines of a table of cases by engines, with a column per release, from stored rows of text."""
    run = table[table["case"] != ""]
    release = run["versions"].str.partition(";")[0].where(run["versions"] != "", run["engine"])
    run = run.assign(release=release, seconds=pd.to_numeric(run["seconds"]))
    cells = run.groupby(["case", "release"]).apply(_cell).unstack(fill_value="")[release.unique()]
    cells.loc["seconds"] = (
        run.drop_duplicates(["release", "case"]).groupby("release")["seconds"].sum().map("{:.3g}".format)
    )
    return _markdown(["case", *cells], list(cells.itertuples()))


def _cell(rows: pd.DataFrame) -> str:
    """Return the fewest digits of a case's terms, which terms are wrong, and the faults that they look like."""
    judged = rows[rows["is_right"] != ""]
    digits = judged.loc[judged["digits"] != "", "digits"].astype(float)
    if judged.empty:
        return "?" if any(rows["digits"]) else "-"
    wrong = judged[judged["is_right"] == "False"]
    faults = sorted({*wrong["looks_like"]} - {""})
    words = [f"{digits.min():.1f}" if len(digits) else "error"] + ["own"] * (
        "own differences" in set(judged["against"])
    )
    words += [f"wrong: {', '.join(wrong['term'])}"] * len(wrong[:1]) + [f"({'; '.join(faults)})"] * bool(faults)
    return " ".join(words)


def _markdown(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    return [f"| {' | '.join(map(str, row))} |" for row in (heads, ["---"] * len(heads), *rows)]
