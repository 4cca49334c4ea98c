"""The command ``engines``: lists the engines in a Python of their own, makes their environments, writes their table."""

from __future__ import annotations

import re
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from bench.engines import environments, table
from bench.engines.backend import EngineBackend
from bench.engines.conformance import metamorphic
from bench.errors import UserError, local_path, printable, unknown
from bench.model import registry

USAGE = (
    "python -m bench engines [install NAME[==VERSION] ... [--again] | table [NAME[==VERSION] ...] [out=DIR] [key=value ...]"
    " | metamorphic MODEL.xml [NAME[==VERSION]] [steps=60] [seed=0] | set OUT] [plugins=DIR]"
)


def main(words: Sequence[str]) -> int:
    """List all engines with the state of their environments, install the named ones, or write the table; return the status."""
    out = Path("results/engines_table")
    for word in words:
        if word.startswith("plugins="):
            registry.add_folder(Path(word.partition("=")[2]))
        elif word.startswith("out="):
            out = local_path("out", word.partition("=")[2])
    names = [word for word in words if not word.startswith(("plugins=", "out=", "--again"))]
    if not names:
        return _list()
    if names[0] == "table":
        settings = [name for name in names[1:] if "=" in name and "==" not in name]
        wanted = [name for name in names[1:] if name not in settings]
        for name in wanted:
            registry.find("backends", name.partition("==")[0])
        print(table.write(wanted, out, settings))
        return 0
    if names[0] == "metamorphic" and names[1:]:
        return _metamorphic(*names[1:])
    if names[0] == "set" and len(names) == 2:
        return _write_set(Path(names[1]) / "conformance")
    if names[0] != "install" or not names[1:]:
        raise UserError(f"engines: {' '.join(names)} is not a request: {USAGE}")
    engines, requirements = _engines(), {}
    for word in names[1:]:
        name, _, release = word.partition("==")
        plugin = registry.find("backends", name).plugin if release else engines.get(name)
        if plugin is None:
            raise unknown("engine", name, engines)
        is_outside = name in engines
        requirements[word] = engines[name].requirements() if is_outside else table.file_of(plugin, ".txt")
        if not requirements[word].exists():
            raise UserError(f"engine {name} has no file of requirements {requirements[word]}")
    for word, file in requirements.items():
        started = time.perf_counter()
        place = environments.install(word, file, again="--again" in words)
        size = sum(file.lstat().st_size for file in place.rglob("*"))
        print(f"{word}: installed in {place}, {size / 2**20:.0f} MiB, {time.perf_counter() - started:.0f} s")
        if word in engines and (reason := engines[word]().unavailable_reason()):
            print(f"bench: {reason}", file=sys.stderr)
            return 1
    return 0


def _engines() -> dict[str, type[EngineBackend]]:
    """Return the engines by name."""
    entries = registry.entries()["backends"].items()
    return {name: e.plugin for name, e in entries if e.plugin is not None and issubclass(e.plugin, EngineBackend)}


def _write_set(out: Path) -> int:
    """Copy the conformance set with its version to a new folder, for tests of an engine without this package."""
    if out.exists():
        raise UserError(f"engines set: {out} exists: remove it or choose another folder")
    shutil.copytree(Path(metamorphic.__file__).parent, out, ignore=shutil.ignore_patterns("__pycache__"))
    version = sys.modules["bench"].__version__
    (out / "VERSION").write_text(f"{version}\n")
    print(f"{out}: the conformance set of {version}")
    return 0


def _metamorphic(model: str, *words: str) -> int:
    """Print a line per property of an engine on a model, by default of ``mujoco``; return 1 if one does not hold."""
    if not Path(model).is_file():
        raise UserError(f"engines metamorphic: the file {model} does not exist: {USAGE}")
    settings = [word for word in words if "=" in word and "==" not in word]
    names = [word for word in words if word not in settings]
    if unknown_names := [word for word in settings if not re.fullmatch(r"(steps|seed)=\d+", word)]:
        raise UserError(f"engines metamorphic: {' '.join(unknown_names)} is not a setting: {USAGE}")
    word = names[0] if names else "mujoco"
    name, _, release = word.partition("==")
    plugin, python = registry.usable("backends", name), str(environments.python_of(word)) if release else ""
    if release and (reason := environments.missing(word, python, ())):
        raise UserError(reason)
    file, script = table.file_of(plugin, "_metamorphic.py"), Path(metamorphic.__file__)
    if not file.exists():
        raise UserError(f"engines metamorphic: engine {name} has no file {file}")
    rows = table.rows_of(plugin(), file, script, str(Path(model).resolve()), *settings, python=python)
    for row in rows:
        state = {True: "holds", False: "broken", None: "-"}[row.get("holds")]
        at = f"first at step {row['step']}" if row.get("step") is not None else row["reason"]
        size = f"{row['worst']:.1e} of {row['tolerance']:.0e}" if row.get("worst") is not None else ""
        print(f"{row.get('property', ''):<34}{state:<8}{size:<20}{at}".rstrip())
    print(f"{rows[0].get('versions', name)}, {Path(model).name}")
    return int(any(row.get("holds") is False or "property" not in row for row in rows))


def _list() -> int:
    for name, engine in _engines().items():
        backend = engine()
        reason = backend.unavailable_reason()
        state = reason or "; ".join(f"{library} {version}" for library, version in backend.library_versions().items())
        print(f"{name:<16}{printable(state)}")
    print(f"environments: {environments.folder()} (set by ${environments.FOLDER})")
    return 0
