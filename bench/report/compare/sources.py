"""Stored results of a directory or of a revision in git, by experiment."""

from __future__ import annotations

import io
import json
import subprocess
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from bench.errors import UserError
from bench.store import IDENTITY, TEXT

TEXTS = {*TEXT, "verdict"}
NEEDED = {*IDENTITY, "status"}
"""Columns without which a table is no table of cells."""


@dataclass(frozen=True)
class Results:
    """The rows of one experiment, and the machine they were made on as far as it is known."""

    rows: pd.DataFrame
    machine: str = ""
    busy: str = ""
    """Its load where that was more than 1.5 for each core."""


@contextmanager
def opened(name: str) -> Iterator[dict[str, Results]]:
    """The results under a directory, or under ``results`` (``REV``) or another path (``REV:PATH``) of a git revision.

    Raises :class:`UserError` for what is neither, and where there are none.
    """
    directory = Path(name).expanduser()
    if directory.is_dir():
        yield _found(directory, name)
        return
    with tempfile.TemporaryDirectory() as temporary:
        revision, _, path = name.partition(":")
        _extract(name, revision, path or "results", Path(temporary))
        yield _found(Path(temporary), name)


def _extract(name: str, revision: str, path: str, where: Path) -> None:
    known = subprocess.run(
        ["git", "rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}"],
        capture_output=True,
        text=True,
    )
    if known.returncode or not revision:
        raise UserError(
            f"'{name}' is neither a directory nor a git revision (REV, or REV:PATH with the path from the top)"
        )
    top = subprocess.run(["git", "rev-parse", "--show-toplevel"], capture_output=True, text=True).stdout.strip()
    packed = subprocess.run(
        ["git", "-C", top, "archive", "--format=tar", known.stdout.strip(), "--", path], capture_output=True
    )
    if packed.returncode:
        raise UserError(f"revision '{revision}' has no '{path}'")
    with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as archive:
        archive.extractall(where, filter="data")


def _found(directory: Path, name: str) -> dict[str, Results]:
    """Every experiment at or below a directory that has rows, or the committed table of them."""
    found: dict[str, Results] = {}
    for place in sorted({path.parent for path in directory.rglob("*") if path.suffix in (".parquet", ".csv")}):
        rows = _rows(place)
        if rows is None:
            continue
        label = str(rows["experiment"].iloc[0]) if "experiment" in rows else place.name
        if label in found:
            raise UserError(f"'{name}' has results of '{label}' in more than one directory: name one of them")
        found[label] = Results(rows.drop_duplicates(list(IDENTITY), keep="last"), *_machine(place))
    if not found:
        raise UserError(f"'{name}' has no results: no rows.parquet and no table (.csv) with a row per cell")
    return found


def _rows(place: Path) -> pd.DataFrame | None:
    """``rows.parquet`` of a directory, else its table; None where there is neither."""
    stored = place / "rows.parquet"
    if stored.exists():
        try:
            return pd.read_parquet(stored)
        except Exception as error:
            raise UserError(f"'{stored}' cannot be read as Parquet ({error})") from None
    for path in sorted(place.glob("*.csv")):
        try:
            table = pd.read_csv(path, dtype=str, keep_default_na=False)
        except (ValueError, UnicodeDecodeError):
            continue
        if set(table) >= NEEDED and "pareto" not in table and len(table):
            numbers = [column for column in table if column not in TEXTS]
            return table.assign(**{column: pd.to_numeric(table[column], errors="coerce") for column in numbers})
    return None


def _machine(place: Path) -> tuple[str, str]:
    """Processor, cores and system from ``run.json``, and the load where it was busy."""
    try:
        machine = json.loads((place / "run.json").read_text())["machine"]
        name = f"{machine['processor']}, {machine['cores']} cores, {machine['system']}"
        load = (machine["load_average"] or [0.0])[0]
        return name, f"load {load:.1f}" if load > 1.5 * machine["cores"] else ""
    except (OSError, ValueError, KeyError, TypeError):
        return "", ""
