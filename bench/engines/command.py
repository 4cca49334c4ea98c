"""The command ``engines``: lists the engines in a Python of their own, makes their environments, writes their table."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from bench.engines import environments, table
from bench.engines.conformance import metamorphic
from bench.errors import UserError, local_path, printable
from bench.model import registry

OUT = Path("results/engines_table")
"""Folder of the table."""
USAGE = (
    "python -m bench engines [install NAME[==VERSION] ... [--again] | table [NAME[==VERSION] ...] [out=DIR] [key=value ...]"
    " | metamorphic MODEL.xml [NAME[==VERSION]] [steps=60] [seed=0] | set OUT] [plugins=DIR]"
)


def main(words: Sequence[str]) -> int:
    """List all engines with the state of their environments, install the named ones, or write the table; return the status."""
    given = [word for word in words if not word.startswith("plugins=")]
    for word in set(words) - set(given):
        registry.add_folder(Path(word.partition("=")[2]))
    match given:
        case []:
            return _list()
        case ["table", *rest]:
            return _table(rest)
        case ["metamorphic", model, *rest]:
            return _metamorphic(model, rest)
        case ["set", out]:
            return _write_set(Path(out) / "conformance")
        case ["install", *rest] if names := [word for word in rest if word != "--again"]:
            return _install(names, "--again" in rest)
    raise UserError(f"engines: {' '.join(given)} is not a request: {USAGE}")


def _split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the names of engines and the settings ``KEY=VALUE`` among words."""
    settings = [word for word in words if "=" in word and "==" not in word]
    return [word for word in words if word not in settings], settings


def _install(words: Sequence[str], again: bool) -> int:
    """Make the environments of ``NAME`` or ``NAME==VERSION``; return 1 if an engine cannot be used then."""
    files = {word: table.Engine(word).file(".txt") for word in words}
    for word, file in files.items():
        if not file.exists():
            raise UserError(f"engine {word} has no file of requirements {file}")
    for word, file in files.items():
        started = time.perf_counter()
        place = environments.install(word, file, again=again)
        size = sum(file.lstat().st_size for file in place.rglob("*"))
        print(f"{word}: installed in {place}, {size / 2**20:.0f} MiB, {time.perf_counter() - started:.0f} s")
        if reason := table.Engine(word).missing:
            print(f"bench: {reason}", file=sys.stderr)
            return 1
    return 0


def _table(words: Sequence[str]) -> int:
    """Write the table of the named engines, or of all, and print the page's path."""
    names, settings = _split(words)
    places = [word for word in settings if word.startswith("out=")]
    out = local_path("out", places[-1].partition("=")[2]) if places else OUT
    settings = [word for word in settings if word not in places]
    # before the set runs for minutes
    plan = [sys.executable, "-m", "bench", "plan", f"+experiment={table.GRADIENTS}", *settings]
    if settings and subprocess.run(plan, stdout=subprocess.DEVNULL).returncode:
        raise UserError(f"engines table: the experiment {table.GRADIENTS} refuses {' '.join(settings)}")
    print(table.write([table.Engine(name) for name in names], out, settings))
    return 0


def _write_set(out: Path) -> int:
    """Copy the conformance set with its version to a new folder, for tests of an engine without this package."""
    if out.exists():
        raise UserError(f"engines set: {out} exists: remove it or choose another folder")
    shutil.copytree(Path(metamorphic.__file__).parent, out, ignore=shutil.ignore_patterns("__pycache__"))
    version = sys.modules["bench"].__version__
    (out / "VERSION").write_text(f"{version}\n")
    print(f"{out}: the conformance set of {version}")
    return 0


def _metamorphic(model: str, words: Sequence[str]) -> int:
    """Print a line per property of an engine on a model, by default of ``mujoco``; return 1 if one is broken, or all unchecked."""
    if not Path(model).is_file():
        raise UserError(f"engines metamorphic: the file {model} does not exist: {USAGE}")
    names, settings = _split(words)
    if strange := [*names[1:], *(word for word in settings if not re.fullmatch(metamorphic.SETTING, word))]:
        raise UserError(f"engines metamorphic: {' '.join(strange)} is not a setting: {USAGE}")
    rows = table.Engine([*names, "mujoco"][0]).rows(metamorphic, str(Path(model).resolve()), *settings)
    if "property" not in rows[0]:
        raise UserError(f"engines metamorphic: {rows[0]['reason']}")
    for row in rows:
        state = {True: "holds", False: "broken", None: "-"}[row.get("holds")]
        at = [f"first at step {row['step']}"] if row.get("step") is not None else []
        size = f"{row['worst']:.1e} of {row['tolerance']:.0e}" if row.get("worst") is not None else ""
        print(
            f"{row.get('property', ''):<35}{state:<8}{size:<20}{': '.join([*at, *filter(None, [row['reason']])])}".rstrip()
        )
    print(f"{rows[0]['versions']}, {Path(model).name}")
    verdicts = {row.get("holds") for row in rows}
    return int(False in verdicts or True not in verdicts or "property" not in rows[-1])


def _list() -> int:
    for engine in table.engines():
        if engine.is_outside:
            backend = engine.plugin()
            versions = "; ".join(f"{library} {version}" for library, version in backend.library_versions().items())
            print(f"{engine.name:<16}{printable(backend.unavailable_reason() or versions)}")
    print(f"environments: {environments.folder()} (set by ${environments.FOLDER})")
    return 0
