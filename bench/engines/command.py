"""The command ``engines``: lists the engines in a Python of their own, makes their environments, writes their table."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

from bench.engines import environments, table
from bench.engines.backend import EngineBackend
from bench.errors import UserError, local_path, printable, unknown
from bench.model import registry

USAGE = (
    "python -m bench engines [install NAME ... [--again] | table [NAME ...] [out=DIR] [key=value ...]] [plugins=DIR]"
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
        settings = [name for name in names[1:] if "=" in name]
        wanted = [name for name in names[1:] if "=" not in name]
        for name in wanted:
            registry.find("backends", name)
        print(table.write(wanted, out, settings))
        return 0
    if names[0] != "install" or not names[1:]:
        raise UserError(f"engines: {' '.join(names)} is not a request: {USAGE}")
    engines = _engines()
    for name in names[1:]:
        if name not in engines:
            raise unknown("engine", name, engines)
        if not engines[name].requirements().exists():
            raise UserError(f"engine {name} has no file of requirements {engines[name].requirements()}")
    for name in names[1:]:
        started = time.perf_counter()
        place = environments.install(name, engines[name].requirements(), again="--again" in words)
        size = sum(file.lstat().st_size for file in place.rglob("*"))
        print(f"{name}: installed in {place}, {size / 2**20:.0f} MiB, {time.perf_counter() - started:.0f} s")
        if reason := engines[name]().unavailable_reason():
            print(f"bench: {reason}", file=sys.stderr)
            return 1
    return 0


def _engines() -> dict[str, type[EngineBackend]]:
    """Return the engines by name."""
    entries = registry.entries()["backends"].items()
    return {name: e.plugin for name, e in entries if e.plugin is not None and issubclass(e.plugin, EngineBackend)}


def _list() -> int:
    for name, engine in _engines().items():
        backend = engine()
        reason = backend.unavailable_reason()
        state = reason or "; ".join(f"{library} {version}" for library, version in backend.library_versions().items())
        print(f"{name:<16}{printable(state)}")
    print(f"environments: {environments.folder()} (set by ${environments.FOLDER})")
    return 0
