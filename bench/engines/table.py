"""The table of engines: the conformance set and the experiment ``engine_gradients`` on all that are installed."""

from __future__ import annotations

import inspect
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd

from bench.engines import environments
from bench.engines.backend import EngineBackend
from bench.engines.conformance import runner
from bench.errors import UserError, printable
from bench.model import registry

COLUMNS = ("engine", "versions", *runner.COLUMNS, "command")
GRADIENTS = "engine_gradients"
"""The experiment whose table is on the page too."""


class Engine:
    """A backend's engine: ``NAME``, or ``NAME==VERSION`` in an environment of another release."""

    def __init__(self, word: str) -> None:
        self.word, (self.name, sign, self.release) = word, word.partition("==")
        if sign and not self.release:
            raise UserError(f"engine {word} has no release: write {word}VERSION or {word}newest")
        entry = registry.find("backends", self.name)
        self.plugin: Any = entry.plugin
        self.is_outside = self.plugin is not None and issubclass(self.plugin, EngineBackend)
        """Whether the harness runs it in a Python of its own."""
        self.is_here = not self.is_outside and not self.release
        self.python = sys.executable if self.is_here else str(environments.python_of(word))
        libraries = getattr(self.plugin, "libraries", ())
        self.missing = entry.reason if self.is_here else environments.missing(word, None, libraries) or ""
        """Why it cannot run, or empty."""

    def file(self, end: str) -> Path:
        """Return the file ``NAME`` + ``end`` in the folder ``engines`` of the backend's engine, which may not exist."""
        plugin: Any = registry.usable("backends", self.name)
        here = Path(inspect.getfile(plugin)).parents[1] / "engines"
        return (plugin.files()[0].parent if self.is_outside else here) / f"{self.name}{end}"

    def rows(self, script: ModuleType, *words: str) -> list[dict[str, Any]]:
        """Return the rows of a script of the conformance set, run in this engine's Python.

        If it cannot run, the run fails or takes longer than two hours, the last row has the reason.
        """
        if self.missing:
            return [{"reason": self.missing}]
        file = self.file("_conformance.py")
        if not file.exists():
            return [{"reason": f"{self.name} is not an engine of the conformance set: there is no file {file.name}"}]
        path = {} if self.is_outside else {"PYTHONPATH": str(Path(runner.__file__).parents[3])}
        return run(self.python, script, str(file), *words, environment=os.environ | path)


def engines() -> list[Engine]:
    """Return all engines: backends in a Python of their own, and those with a file ``engines/NAME_conformance.py``."""
    found = [Engine(name) for name, entry in registry.entries()["backends"].items() if entry.plugin is not None]
    return [engine for engine in found if engine.is_outside or engine.file("_conformance.py").exists()]


def write(names: Sequence[Engine], out: Path, settings: Sequence[str] = ()) -> Path:
    """Run the named engines, or all, write ``engines.csv`` and ``engines.md``, and return the page's path.

    Rows of other engines and of other versions, which ``out`` has already, stay. ``settings`` are the experiment's, which
    has a folder per set of releases.
    """
    rows: list[dict[str, Any]] = []
    backends: list[str] = []
    for engine in names or engines():
        own, known = engine.rows(runner), {"versions": "", "engine": engine.name}
        rows += [known | row | {"command": f"python -m bench engines table {engine.word}"} for row in own]
        if "case" in own[0] and (engine.is_outside or not engine.release):
            backends.append(f"{engine.name}[python={engine.python}]" if engine.release else engine.name)
    out.mkdir(parents=True, exist_ok=True)
    table, stored = pd.DataFrame(rows, columns=list(COLUMNS)), out / "engines.csv"
    releases = sorted({versions.partition(";")[0] for versions in table["versions"]} - {""})
    if stored.exists():
        old = read(stored)
        is_new = old["engine"].isin(table["engine"]) & old["versions"].isin(["", *table["versions"]])
        table = pd.concat([old[~is_new], table]).sort_values(["engine", "versions"], kind="stable")
    # an engine may be named twice, or its release be installed here and in an environment
    table = table.drop_duplicates(["engine", "versions", "case", "term"], keep="last")
    table.to_csv(stored, index=False)
    place = out / ", ".join(releases).replace(" ", "-").replace(",-", ",")
    words = [f"+experiment={GRADIENTS}", f"backends=[{','.join(backends)}]", f"results_dir='{place}'", *settings]
    if backends:
        subprocess.run([sys.executable, "-m", "bench", *words], check=False)
    page = out / "engines.md"
    parts = [
        f"\n# {file.parents[1].name}\n\n{file.read_text()}" for file in sorted(out.glob(f"*/{GRADIENTS}/engines.md"))
    ]
    page.write_text(_page(read(stored)) + "".join(parts))
    return page


def read(file: Path) -> pd.DataFrame:
    """Return stored rows, all as text."""
    return pd.read_csv(file, dtype=str, keep_default_na=False)


def run(
    python: str, script: ModuleType, *words: str, environment: dict[str, str] | None = None
) -> list[dict[str, Any]]:
    """Return the rows that a script of the conformance set prints in a Python."""
    reason = ""
    with tempfile.TemporaryFile("w+") as output:
        try:
            done = subprocess.run(
                [python, str(script.__file__), *words],
                env=environment,
                text=True,
                timeout=7200.0,
                stdout=output,
                stderr=subprocess.PIPE,
            )
            if done.returncode != runner.WRONG:
                done.check_returncode()
        except (OSError, subprocess.SubprocessError) as error:
            # after the frames of a traceback, which are indented, are the lines of the error
            last = printable(re.split(r"^ .*\n", getattr(error, "stderr", "") or "", flags=re.MULTILINE)[-1])
            how = str(error).rpartition("]' ")[2]
            reason = f"stopped: {how} {last[-200:]}".strip()
        output.seek(0)
        lines = [json.loads(line) for line in output if line.startswith("{")]
    versions = "; ".join(f"{library} {version}" for library, version in lines[0]["versions"].items()) if lines else ""
    return [{"versions": versions, **row} for row in [*lines[1:], *[{"reason": reason}] * bool(reason)]]


def _page(table: pd.DataFrame) -> str:
    """Return the page: a line per engine, cases by releases, verdicts that changed, and the reasons for what is missing."""
    engines = [
        [
            name,
            versions,
            *((own["is_right"] == verdict).sum() for verdict in ("True", "False")),
            f"`{own['command'].iloc[0]}`",
        ]
        for (name, versions), own in table.groupby(["engine", "versions"], sort=False)
    ]
    release = table["versions"].str.split(";").str[0].where(table["versions"] != "", table["engine"])
    table = table.assign(release=release)  # the engine's first library with its version, or the engine
    told, run = (table[table[name] != ""] for name in ("reason", "case"))
    cases = told["case"].str.cat(told["term"].where(told["is_right"] == "False", ""), sep=" ").str.strip()
    reasons = told.assign(case=cases).drop_duplicates(["release", "case"]).groupby(["release", "reason"])["case"]
    notes = [f"- {', '.join([name, *filter(None, of)])}: {printable(why)[:240]}" for (name, why), of in reasons]
    return "\n".join(
        [
            "# Conformance of physics engines",
            "",
            *_markdown(["engine", "versions", "right", "not right", "command"], engines),
            "",
            "The fewest digits of a case's derivatives. own: compared with the engine's own differences. -: not run. ?: cannot tell.",
            "",
            *_by_case(run),
            "",
            *_changes(run),
            "",
            *notes,
            "",
        ]
    )


def _by_case(run: pd.DataFrame) -> list[str]:
    """Return the Markdown lines of a table of cases by engines, with a column per release, from stored rows of text."""
    if run.empty:
        return []
    run = run.assign(seconds=pd.to_numeric(run["seconds"]))
    cells = run.groupby(["case", "release"]).apply(_cell).unstack(fill_value="")[run["release"].unique()]
    cells.loc["seconds"] = (
        run.drop_duplicates(["release", "case"]).groupby("release")["seconds"].sum().map("{:.3g}".format)
    )
    return _markdown(["case", *cells], list(cells.itertuples()))


def _changes(run: pd.DataFrame) -> list[str]:
    """Return the Markdown lines of a table of verdicts that differ between releases of an engine, from stored rows of text."""
    lines = []
    for _, own in run.groupby("engine", sort=False):
        verdicts = own.pivot(index=["case", "term"], columns="release", values="is_right").dropna()
        changed = verdicts[verdicts.nunique(axis=1) > 1].replace({"True": "right", "False": "wrong", "": "?"})
        if len(changed):
            rows = changed.reset_index()
            lines += _markdown(list(rows), list(rows.itertuples(index=False)))
    return lines


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
