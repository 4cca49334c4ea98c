"""Rows on disk.

Rows that finish together are one small JSON file under ``pending/``; at the end of a run the small files are folded into
``rows.parquet``. Every file is written whole under a name of its own and renamed into place, and is deleted only by
who has read it and written its rows into another. So nothing is locked, a run can be killed at any moment, and
several can write to one directory: what is stored is the union of all files, the newest row of each key.
"""

from __future__ import annotations

import io
import json
import math
import os
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.errors import StorageError

if TYPE_CHECKING:
    import pandas as pd

IDENTITY = [
    "scene", "contact", "integrator", "backend", "estimator", "estimator_params", "noise", "horizon", "dt",
    "stiffness", "sigma", "smoothing", "samples", "repeats", "seed", "dtype",
]  # fmt: skip
"""The columns that say which cell a row is, whatever version of the code made it."""
TEXT = [
    "experiment", "scene", "contact", "integrator", "backend", "estimator", "estimator_params", "noise", "status",
    "reason", "dtype", "versions", "key",
]  # fmt: skip
"""The columns of every study that are text."""

ATTEMPTS = 100
"""Times that a directory is read anew while other runs change it."""
STALE_S = 3600.0
"""Age at which a half written file belongs to no run."""


@dataclass(frozen=True)
class Columns:
    """The columns of a study's rows, in order. Beside the texts and lists all are numbers."""

    names: tuple[str, ...]
    texts: tuple[str, ...] = ()
    lists: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()
    """Columns of ``rows.parquet`` that the table leaves out."""
    measured: tuple[str, ...] = ()
    """Columns that depend on the machine and its load: NaN where cells are not timed."""

    @classmethod
    def of(cls, *own: str, texts: tuple[str, ...] = (), lists: tuple[str, ...] = ()) -> Columns:
        """Identity, status and reason, then a study's own columns: ``own`` numbers, texts, lists."""
        names = ["experiment", *IDENTITY, "dim", "status", "reason", *own, *texts, *lists, "versions", "key"]
        return cls(tuple(names), texts, lists)

    @property
    def stored(self) -> list[str]:
        """All columns of ``rows.parquet``: beside the table's, seconds in all and when it was stored, since 1970."""
        return [*self.names, *self.extra, "wall_s", "stored_at"]

    @property
    def referenced(self) -> bool:
        """Whether rows name a reference gradient that they are held to."""
        return "reference_method" in self.names

    def blank(self) -> dict[str, Any]:
        """A row without any value."""
        texts = {*TEXT, *self.texts}
        return {n: "" if n in texts else [] if n in self.lists else math.nan for n in self.stored}

    def typed(self, table: pd.DataFrame) -> pd.DataFrame:
        """The columns in order: texts as text, lists as they are, the others as numbers."""
        import pandas as pd

        table = table.reindex(columns=self.stored).copy()
        for name in self.stored:
            if name in TEXT or name in self.texts:
                table[name] = table[name].astype(object).fillna("").astype(str)
            elif name not in self.lists:
                table[name] = pd.to_numeric(table[name], errors="coerce").astype("float64")
        return table


BIAS_VARIANCE = Columns(
    (
        "experiment", "scene", "contact", "integrator", "backend", "estimator", "estimator_params", "noise",
        "horizon", "dt", "stiffness", "sigma", "smoothing", "samples", "repeats", "dim", "seed", "status", "reason",
        "grad_norm", "reference_norm", "reference_method", "reference_se", "bias", "bias_low", "bias_high",
        "bias_rel", "variance", "variance_per_sample", "rmse", "rmse_rel", "cosine", "sign_agreement",
        "finite_fraction", "model_error", "time_s", "time_iqr_s", "compile_s", "rollouts", "gradients",
        "peak_memory_mb", "dtype", "device", "versions", "key",
    ),
    texts=("reference_method", "device", "shapes"),
    lists=("time_samples",),
    extra=("variance_low", "variance_high", "time_samples", "estimates_s", "compilations", "shapes"),
    measured=(
        "time_s", "time_iqr_s", "time_samples", "estimates_s", "compile_s", "peak_memory_mb", "compilations", "shapes",
    ),
)  # fmt: skip
"""The columns of the main table: a contract with people's scripts."""


class Store:
    """The rows of one experiment. Raises :class:`StorageError` when its directory cannot be written or read."""

    def __init__(self, directory: Path, columns: Columns = BIAS_VARIANCE) -> None:
        self.directory = directory
        self._columns = columns
        self._table = directory / "rows.parquet"
        self._pending = directory / "pending"

    def prepare(self) -> None:
        """Make the directory, and make sure that it can be written."""
        try:
            self._pending.mkdir(parents=True, exist_ok=True)
            probe = self._pending / f".probe-{uuid.uuid4().hex}"
            probe.write_text("")
            probe.unlink()
        except OSError as error:
            raise StorageError(f"results directory '{self.directory}' cannot be written: {error.strerror}") from None

    def append(self, *rows: dict[str, Any]) -> None:
        """Store finished cells: when this returns they outlast a power cut."""
        stamped = [row | {"stored_at": time.time()} for row in rows]
        self._add("json", json.dumps(stamped).encode())

    def load(self) -> pd.DataFrame:
        """All stored rows, the newest of each key, those of ``rows.parquet`` first."""
        return self._read_all()[0]

    def compact(self, order: Sequence[str] = ()) -> None:
        """Fold the small files into ``rows.parquet``, rows of the keys in ``order`` last and in that order."""
        for _ in range(ATTEMPTS):
            table, files = self._read_all()
            known = files.pop(self._table, None)
            if not files or self._fold(ordered(table, order), list(files), known):
                break
        self._tidy()

    # ------------------------------------------------------------------------------------------- reading

    def _files(self) -> dict[Path, tuple[int, int]]:
        """The files that hold rows, each with what tells it from another of its name."""
        pending = sorted(self._pending.glob("[!.]*")) if self._pending.is_dir() else []
        found = {}
        for path in [self._table, *pending]:
            with suppress(FileNotFoundError, NotADirectoryError):
                found[path] = _mark(path)
        return found

    def _read_all(self) -> tuple[pd.DataFrame, dict[Path, tuple[int, int]]]:
        """All rows, and the files they were read from; again when a run nearby folds files meanwhile."""
        for _ in range(ATTEMPTS):
            files = self._files()
            try:
                frames = [self._columns.typed(frame) for frame in _frames(files)]
            except FileNotFoundError:
                continue
            if files.items() <= self._files().items():
                return self._union(frames), files
        raise StorageError(f"'{self.directory}' changes faster than it can be read: too many runs write to it")

    def _union(self, frames: list[pd.DataFrame]) -> pd.DataFrame:
        import pandas as pd

        if not frames:
            return pd.DataFrame(columns=self._columns.stored)
        table = pd.concat(frames, ignore_index=True)
        newest = table.sort_values("stored_at", kind="stable", na_position="first").drop_duplicates("key", keep="last")
        return newest.sort_index().reset_index(drop=True)

    # ------------------------------------------------------------------------------------------- writing

    def _add(self, suffix: str, content: bytes) -> Path:
        """A new file under ``pending/``, which a run nearby may be removing because it is empty."""
        path = self._pending / f"{uuid.uuid4().hex}.{suffix}"
        for _ in range(ATTEMPTS):
            try:
                self._pending.mkdir(exist_ok=True)
                _write(path, content)
            except FileNotFoundError:
                continue
            except OSError as error:
                raise StorageError(f"'{self._pending}' cannot be made: {error.strerror}") from None
            return path
        raise StorageError(f"'{self._pending}' cannot be made")

    def _fold(self, table: pd.DataFrame, read: list[Path], known: tuple[int, int] | None) -> bool:
        """Write the rows of the files that were read into one, and make it ``rows.parquet``.

        False where another run has put its own there meanwhile: its rows have to be read too.
        """

        buffer = io.BytesIO()
        table.to_parquet(buffer, index=False)
        part = self._add("parquet", buffer.getvalue())
        for path in read:
            path.unlink(missing_ok=True)
        aside = self._pending / f"{uuid.uuid4().hex}.parquet"
        try:
            with suppress(FileNotFoundError):
                os.rename(self._table, aside)
                if _mark(aside) != known:
                    return False
            _link(part, self._table)
            _sync(self.directory)
        except FileExistsError:
            return False
        except OSError as error:
            raise StorageError(
                f"'{self._table}' cannot be written: {error.strerror}; its rows are in '{part}'"
            ) from None
        part.unlink(missing_ok=True)
        aside.unlink(missing_ok=True)
        return True

    def _tidy(self) -> None:
        """Remove what killed runs have left half written, and the directory of small files when it is empty."""
        with suppress(OSError):
            for path in self._pending.glob(".*"):
                if time.time() - path.stat().st_mtime > STALE_S:
                    path.unlink()
            self._pending.rmdir()


def ordered(table: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """The table with the rows of these keys in their order, after all others."""
    place = {key: index for index, key in enumerate(keys)}
    position = table["key"].map(lambda key: place.get(key, -1))
    return table.iloc[position.argsort(kind="stable")].reset_index(drop=True)


def _link(path: Path, name: Path) -> None:
    """Give a file a second name; raises FileExistsError where it is taken, as a rename would not."""
    try:
        os.link(path, name)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        os.rename(path, name)


def _mark(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_ino, found.st_mtime_ns


def _frames(paths: Iterable[Path]) -> Iterator[pd.DataFrame]:
    import pandas as pd

    rows: list[dict[str, Any]] = []
    for path in paths:
        try:
            if path.suffix == ".parquet":
                # opened once: a path is opened for the schema and again for the pages, and may be replaced in between
                yield pd.read_parquet(io.BytesIO(path.read_bytes()))
            else:
                read = json.loads(path.read_text())
                rows.extend(read if isinstance(read, list) else [read])
        except FileNotFoundError:
            raise
        except Exception as error:
            said = " ".join(str(error).split())
            what = "Parquet" if path.suffix == ".parquet" else "JSON"
            raise StorageError(f"'{path}' cannot be read as {what} ({said}); move it away to start afresh") from None
    if rows:
        yield pd.DataFrame(rows)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is the old one or the new one, never a part; raises :class:`StorageError` if it cannot."""
    try:
        _write(path, content)
    except OSError as error:
        raise StorageError(f"'{path}' cannot be written: {error.strerror}") from None


def _write(path: Path, content: bytes) -> None:
    temporary = path.with_name(f".{path.name}-{uuid.uuid4().hex}")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync(path.parent)
    except FileNotFoundError:
        raise
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise StorageError(f"'{path}' cannot be written: {error.strerror}") from None


def _sync(directory: Path) -> None:
    """Make renames in a directory outlast a power cut."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
