"""Stores rows on disk.

Rows that finish together are one small JSON file under ``pending/``; at the end of a run the small files are folded
into ``rows.parquet``. Every file is written whole under a name of its own and renamed into place, and is deleted only
by a run that has read it and written its rows into another file. So nothing is locked, a run can be killed at any
moment, and several can write to one directory: what is stored is the union of all files, the newest row of each key.
"""

from __future__ import annotations

import io
import json
import os
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.errors import StorageError
from bench.sweep.columns import Columns
from bench.sweep.files import replace_file, sync

if TYPE_CHECKING:
    import pandas as pd

ATTEMPTS = 100
"""Times that a directory is read again while other runs change it."""
STALE_S = 3600.0
"""Age at which a half-written file belongs to no run."""


class Store:
    """The rows of one experiment. Raises :class:`StorageError` when its directory cannot be written or read."""

    def __init__(self, directory: Path, columns: Columns) -> None:
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
        """Store finished cells: when this returns, they outlast a power cut."""
        stamped = [row | {"stored_at": time.time()} for row in rows]
        self._add("json", json.dumps(stamped).encode())

    def load(self) -> pd.DataFrame:
        """Load all stored rows, the newest of each key, those of ``rows.parquet`` first."""
        return self._read_all()[0]

    def compact(self, order: Sequence[str] = ()) -> None:
        """Fold the small files into ``rows.parquet``, rows of the keys in ``order`` last and in that order."""
        for _ in range(ATTEMPTS):
            table, files = self._read_all()
            mark = files.pop(self._table, None)
            if not files or self._fold(ordered(table, order), list(files), mark):
                break
        self._tidy()

    # ------------------------------------------------------------------------------------------- reading

    def _files(self) -> dict[Path, tuple[int, int]]:
        """Return the files that hold rows, each with a mark that distinguishes it from another file of its name."""
        pending = sorted(self._pending.glob("[!.]*")) if self._pending.is_dir() else []
        marks = {}
        for path in [self._table, *pending]:
            with suppress(FileNotFoundError, NotADirectoryError):
                marks[path] = _mark(path)
        return marks

    def _read_all(self) -> tuple[pd.DataFrame, dict[Path, tuple[int, int]]]:
        """Read all rows, and return the files they came from; read again if another run folds files meanwhile."""
        for _ in range(ATTEMPTS):
            files = self._files()
            try:
                frames = [self._columns.typed(frame) for frame in _frames(files)]
            except FileNotFoundError:
                continue
            # a file folded while others were read may have been missed in both places
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
        """Add a file under ``pending/``, a folder that another run may be removing because it is empty."""
        path = self._pending / f"{uuid.uuid4().hex}.{suffix}"
        for _ in range(ATTEMPTS):
            try:
                self._pending.mkdir(exist_ok=True)
                replace_file(path, content)
            except FileNotFoundError:
                continue
            except OSError as error:
                raise StorageError(f"'{self._pending}' cannot be made: {error.strerror}") from None
            return path
        raise StorageError(f"'{self._pending}' cannot be made")

    def _fold(self, table: pd.DataFrame, read: list[Path], mark: tuple[int, int] | None) -> bool:
        """Write the rows of the files that were read into one, and make it ``rows.parquet``.

        Returns False if another run has put its own ``rows.parquet`` there meanwhile: its rows have to be read too.
        """

        buffer = io.BytesIO()
        table.to_parquet(buffer, index=False)
        # the rows are in one new file before the old files go, so a kill at any moment loses none
        part = self._add("parquet", buffer.getvalue())
        for path in read:
            path.unlink(missing_ok=True)
        aside = self._pending / f"{uuid.uuid4().hex}.parquet"
        try:
            with suppress(FileNotFoundError):
                # moved aside first: only then is it certain which file is being replaced
                os.rename(self._table, aside)
                if _mark(aside) != mark:
                    return False
            _link(part, self._table)
            sync(self.directory)
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
        """Remove half-written files of killed runs, and the directory of small files when it is empty."""
        with suppress(OSError):
            for path in self._pending.glob(".*"):
                if time.time() - path.stat().st_mtime > STALE_S:
                    path.unlink()
            self._pending.rmdir()


def ordered(table: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """Return the table with the rows of these keys in their order, after all others."""
    place = {key: index for index, key in enumerate(keys)}
    position = table["key"].map(lambda key: place.get(key, -1))
    return table.iloc[position.argsort(kind="stable")].reset_index(drop=True)


def _link(path: Path, name: Path) -> None:
    """Give a file a second name; raises FileExistsError if that is taken, where a rename would overwrite it."""
    try:
        os.link(path, name)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        os.rename(path, name)


def _mark(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_ino, status.st_mtime_ns


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
