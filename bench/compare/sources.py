"""Reads the stored results of a directory or a git revision, by experiment."""

from __future__ import annotations

import hashlib
import io
import subprocess
import tarfile
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from bench.errors import UserError
from bench.experiment.columns import Columns
from bench.experiment.keys import hashed
from bench.experiment.study import columns_of
from bench.model import registry
from bench.run.rows import read_record, valid_rows
from bench.run.store import Store

STANDARD = "standard"
"""The folder of committed results inside the results folder."""


@dataclass(frozen=True)
class Results:
    """The rows of one experiment, and the machine that ran it, if known."""

    rows: pd.DataFrame
    study: str
    content: str = ""
    """A hash of the files of its rows."""
    machine: str = ""

    @property
    def columns(self) -> Columns:
        """The columns of its study."""
        return columns_of(self.study)

    @property
    def is_installed(self) -> bool:
        """Whether its study is installed."""
        return self.study in registry.entries()["studies"]


def read_results(name: str) -> dict[str, Results]:
    """Return the results in a directory, or in ``results`` (``REV``) or a path (``REV:PATH``) of a git revision.

    Results in a folder ``standard`` are read only if there are no others. Raises :class:`UserError` if the name is
    neither a directory nor a revision, or if there are no results.
    """
    directory = Path(name).expanduser()
    if directory.is_dir():
        return _read_all(directory, name)
    with tempfile.TemporaryDirectory() as temporary:
        revision, _, path = name.partition(":")
        _extract(name, revision, path or "results", Path(temporary))
        return _read_all(Path(temporary), name)


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
    """Return the results of every experiment with stored rows in a directory or below it."""
    folders = sorted({path.parent for part in ("rows.parquet", "pending") for path in directory.rglob(part)})
    own = [folder for folder in folders if STANDARD not in folder.relative_to(directory).parts]
    results: dict[str, Results] = {}
    for label, read in filter(None, map(_read, own or folders)):
        if label in results:
            raise UserError(f"'{name}' has results of '{label}' in more than one directory: name one of them")
        results[label] = read
    if not results:
        raise UserError(f"'{name}' has no results{'' if folders else ': no rows.parquet or pending'}")
    return results


def _read(folder: Path) -> tuple[str, Results] | None:
    """Return the name and the results of the experiment in a folder, with the column types of its study; None without rows."""
    store = Store(folder, Columns.of())
    rows = store.load()
    if store.left_out:
        raise UserError(f"'{min(store.left_out)}' is damaged: run the experiment again to compare it")
    if rows.empty:
        return None
    if not rows[["study", "parameters"]].map(bool).all(axis=None):
        raise UserError(f"rows in '{folder}' have no parameters: run the experiment again to compare it")
    studies = list(rows["study"].unique())
    if len(studies) != 1:
        raise UserError(f"the rows in '{folder}' are of {len(studies)} studies ({', '.join(studies)})")
    content = hashed(*(hashlib.sha256(path.read_bytes()).hexdigest() for path in store.files()))
    rows = valid_rows(rows, columns_of(studies[0]), folder)
    label = str(rows["experiment"].iloc[0]) or folder.name
    return label, Results(rows, studies[0], content, _read_machine(folder))


def _read_machine(folder: Path) -> str:
    """Return processor, cores and system from ``run.json``; empty if unknown."""
    machine = read_record(folder).get("machine", {})
    facts = [machine.get(name) for name in ("processor", "cores", "system")]
    return "{}, {} cores, {}".format(*facts) if all(facts) else ""
