"""Reads the stored results of a directory or a git revision, by experiment."""

from __future__ import annotations

import io
import subprocess
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from bench.errors import UserError
from bench.experiment.columns import IDENTITY, Columns
from bench.experiment.study import Study
from bench.model import registry
from bench.run.rows import read_parquet, read_record, valid_rows

STANDARD = "standard"
"""The folder of committed results inside the results folder."""
CELLS = {*IDENTITY, "status"}
"""Columns of every table with one row per cell, including tables of older versions."""
NEEDED = {*CELLS, "key", "study", "parameters"}
"""Columns that a comparison needs."""
BUSY = 1.5
"""Load per core above which a machine counts as busy."""


@dataclass(frozen=True)
class Results:
    """The rows of one experiment, and the machine that ran it, if known."""

    rows: pd.DataFrame
    study: str
    machine: str = ""
    busy: str = ""
    """The machine's load, if it was more than BUSY per core."""
    n_outdated: int = 0
    """Number of omitted rows, which an older version wrote without their parameters."""

    @property
    def columns(self) -> Columns:
        """The columns of its study."""
        return columns_of(self.study)


def columns_of(study: str) -> Columns:
    """Return the columns of a study's rows. Raises :class:`UserError` if the study is not installed."""
    plugin = registry.usable("studies", study)
    if not issubclass(plugin, Study):
        raise UserError(f"study '{study}' does not derive from bench.plugin.Study")
    return plugin.columns


@contextmanager
def open_results(name: str) -> Iterator[dict[str, Results]]:
    """Open the results in a directory, or in ``results`` (``REV``) or a path (``REV:PATH``) of a git revision.

    Results in a folder ``standard`` are read only if there are no others. Raises :class:`UserError` if the name is
    neither a directory nor a revision, or if there are no results.
    """
    directory = Path(name).expanduser()
    if directory.is_dir():
        yield _read_all(directory, name)
        return
    with tempfile.TemporaryDirectory() as temporary:
        revision, _, path = name.partition(":")
        _extract(name, revision, path or "results", Path(temporary))
        yield _read_all(Path(temporary), name)


def _extract(name: str, revision: str, path: str, target: Path) -> None:
    """Extract a path of a git revision into a folder."""
    commit = subprocess.run(
        # --end-of-options: a name that starts with a dash must not act as an option
        ["git", "rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}"],
        capture_output=True,
        text=True,
    )
    if commit.returncode or not revision:
        raise UserError(
            f"'{name}' is neither a directory nor a git revision (REV, or REV:PATH with the path from the top)"
        )
    top = subprocess.run(["git", "rev-parse", "--show-toplevel"], capture_output=True, text=True).stdout.strip()
    packed = subprocess.run(
        ["git", "-C", top, "archive", "--format=tar", commit.stdout.strip(), "--", path], capture_output=True
    )
    if packed.returncode:
        raise UserError(f"revision '{revision}' has no '{path}'")
    with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as archive:
        # the filter rejects links and paths that lead out of the folder
        archive.extractall(target, filter="data")


def _read_all(directory: Path, name: str) -> dict[str, Results]:
    """Return the results of every experiment with stored rows or a CSV table of rows in a directory or below it."""
    folders = sorted({path.parent for path in directory.rglob("*") if path.suffix in (".parquet", ".csv")})
    own = [folder for folder in folders if STANDARD not in folder.relative_to(directory).parts]
    results = _read_folders(own, name) or _read_folders(folders, name)
    if not results:
        raise UserError(f"'{name}' has no results: no rows.parquet and no table (.csv) with a row per cell")
    return results


def _read_folders(folders: Sequence[Path], name: str) -> dict[str, Results]:
    results: dict[str, Results] = {}
    for folder in folders:
        rows = _read_rows(folder)
        if rows is None:
            continue
        label = str(rows["experiment"].iloc[0]) if "experiment" in rows else folder.name
        if label in results:
            raise UserError(f"'{name}' has results of '{label}' in more than one directory: name one of them")
        results[label] = _validate(rows, folder, label, name)
    return results


def _validate(rows: pd.DataFrame, folder: Path, label: str, name: str) -> Results:
    """Return the rows that store their study and parameters, with the column types of their study."""
    if not set(rows) >= NEEDED or not (complete := _stores_identity(rows)).any():
        raise UserError(
            f"the results of '{label}' in '{name}' were made by an older version, which did not store the parameters of each "
            "cell: run the experiment again to compare it"
        )
    rows = rows[complete]
    studies = list(rows["study"].unique())
    if len(studies) > 1:
        raise UserError(f"the results of '{label}' in '{name}' are of several studies ({', '.join(studies)})")
    columns = columns_of(studies[0])
    typed = _one_per_cell(columns.typed(rows).reset_index(drop=True), columns)
    return Results(typed, studies[0], *_read_machine(folder), n_outdated=int((~complete).sum()))


def _one_per_cell(rows: pd.DataFrame, columns: Columns) -> pd.DataFrame:
    """Return the last row of each key, or the one with the worst verdict if a cell has several lines, one per check."""
    for column in columns.compared:
        if column.comparison and column.comparison.by == "verdict":
            rank = {verdict: -place for place, verdict in enumerate(column.comparison.order)}
            rows = rows.iloc[
                rows[column.name].map(lambda verdict, rank=rank: rank.get(verdict, 1)).argsort(kind="stable")
            ]
    return rows.drop_duplicates("key", keep="last").sort_index().reset_index(drop=True)


def _stores_identity(rows: pd.DataFrame) -> pd.Series:
    return rows[["study", "parameters"]].map(lambda text: isinstance(text, str) and bool(text)).all(axis=1)


def _read_rows(folder: Path) -> pd.DataFrame | None:
    """Return the rows of a folder: of ``rows.parquet``, else of a CSV table with every value as a string, else None."""
    stored = folder / "rows.parquet"
    if stored.exists():
        try:
            rows = read_parquet(stored)
        except Exception as error:
            raise UserError(f"'{stored}' cannot be read as Parquet ({error})") from None
        name = str(rows["study"].iloc[0]) if len(rows) and "study" in rows else ""
        entry = registry.entries()["studies"].get(name)
        is_study = entry is not None and entry.plugin is not None and issubclass(entry.plugin, Study)
        rows = valid_rows(rows, columns_of(name) if is_study else Columns.of(), stored)
        return rows if len(rows) else None
    older = None
    for path in sorted(folder.glob("*.csv")):
        try:
            table = pd.read_csv(path, dtype=str, keep_default_na=False)
        except (ValueError, UnicodeDecodeError):
            continue
        if len(table) and set(table) >= NEEDED:
            return table
        if len(table) and set(table) >= CELLS:
            older = table
    return older


def _read_machine(folder: Path) -> tuple[str, str]:
    """Return processor, cores and system from ``run.json``, and the load if the machine was busy. Empty if unknown."""
    try:
        machine = read_record(folder)["machine"]
        name = f"{machine['processor']}, {machine['cores']} cores, {machine['system']}"
        load = (machine["load_average"] or [0.0])[0]
        return name, f"load {load:.1f}" if load > BUSY * machine["cores"] else ""
    except (OSError, ValueError, KeyError, TypeError):
        return "", ""
