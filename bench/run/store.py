"""Stores rows on disk.

Rows that finish together are one small JSON file under ``pending/``. At the end of a run the small files are merged
into ``rows.parquet``, by one run at a time, which holds a lock (``flock``). Every file is written completely under a unique
name and then renamed into place, and a small file is deleted only after its rows are in the table. So a run can be killed at
any moment, and several runs can write to one directory: the stored rows are the newest row of each key in all files. The
newest row has the largest ``sequence``, a counter that only grows. Clocks are not used, since they differ between machines
and may be wrong for an hour. Reading and adding rows need no lock. Where the file system has none, small files stay.
"""

from __future__ import annotations

import errno
import fcntl
import io
import json
import os
import random
import sys
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from bench.errors import StorageError, UserError, printable
from bench.experiment.columns import Columns
from bench.run.files import remove_stale, replace_file, temporary, write_whole
from bench.run.rows import read_parquet, valid_rows, valid_small_rows

if TYPE_CHECKING:
    import pandas as pd

PATIENCE_S = 60.0
"""Seconds for which reads and writes are retried while other runs change the directory."""
MAX_PAUSE_S = 0.05
"""Longest pause in seconds between two attempts. Pauses are random, so that two runs do not disturb each other again."""
MAX_SEQUENCE = 2.0**53
"""Larger counts are not exact as float64, so no run has written them."""
FileId = tuple[int, int]
"""Inode and modification time in ns, which distinguish files of the same name."""


class Store:
    """The rows of one experiment. Raises :class:`StorageError` if its directory cannot be written or read.

    With ``study``, a directory that contains rows of another study is refused, so that two studies do not mix.
    """

    def __init__(self, directory: Path, columns: Columns, study: str = "") -> None:
        self.directory = directory
        self._columns = columns
        self._study = study
        self._sequence: int | None = None
        self._files_read: dict[Path, FileId] = {}
        self._spoilt: set[Path] = set()
        """Files with rows that are left out."""
        self._table = directory / "rows.parquet"
        self._pending = directory / "pending"

    def prepare(self) -> None:
        """Create the directory, and check that it can be written."""
        probe = temporary(self._pending / "probe")
        self._in_pending(lambda: probe.write_text(""), f"results directory '{self.directory}' cannot be written")
        probe.unlink(missing_ok=True)
        if self._study and self._list_files() != self._files_read:
            self.load()  # another run has stored rows since the files were read

    @contextmanager
    def _locked(self) -> Iterator[bool]:
        """Hold the lock of the directory; False if its file system has no locks."""
        path, is_locked = self._pending / ".lock", True

        def lock() -> IO[bytes]:
            nonlocal is_locked
            file = path.open("a+b", buffering=0)  # for writing alone a pipe would be waited for
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.close()
                raise
            except OSError:
                is_locked = False
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                    return file
            file.close()  # another run has removed the file
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

        with self._in_pending(lock, f"'{path}' cannot be locked"):
            try:
                yield is_locked
            finally:
                path.unlink(missing_ok=True)

    def _refuse_other_studies(self, studies: Iterable[str]) -> None:
        """Raise :class:`UserError` if ``studies`` contains another study than this store's."""
        others = sorted(set(studies) - {"", self._study}) if self._study else []
        if others:
            raise UserError(
                f"'{self.directory}' holds rows of study {', '.join(map(printable, others))}, and this is study {self._study}: "
                "choose another folder with name=..."
            )

    def append(self, *rows: dict[str, Any]) -> None:
        """Store the rows of finished cells. On return, the rows survive a power failure."""
        if self._sequence is None:
            self.load()
        assert self._sequence is not None
        self._sequence += 1
        stamped = [row | {"stored_at": time.time(), "sequence": self._sequence} for row in rows]
        path, content = self._pending / f"{uuid.uuid4().hex}.json", json.dumps(stamped).encode()
        self._in_pending(lambda: replace_file(path, content), f"'{self._pending}' cannot be created")

    def load(self) -> pd.DataFrame:
        """Return the newest stored row of each key; rows of ``rows.parquet`` come first."""
        return self._read_all()[0]

    def compact(self, order: Sequence[str] = ()) -> None:
        """Merge the small files into ``rows.parquet``; rows of the keys in ``order`` come last, in that order."""
        with self._locked() as is_locked:
            table, files = self._read_all()
            files.pop(self._table, None)
            if files and not is_locked:
                raise StorageError(f"the file system of '{self.directory}' has no locks, so no files are merged there")
            if files:
                self._fold(sort_rows(table, order), list(files))
            remove_stale(self._pending)
        with suppress(OSError):  # the folder is not empty
            self._pending.rmdir()

    # ------------------------------------------------------------------------------------------- reading

    def _list_files(self) -> dict[Path, FileId]:
        """Return the files that contain rows, by path, with their ids."""
        names: list[str] = []
        try:
            names = sorted(name for name in os.listdir(self._pending) if not name.startswith("."))
        except (FileNotFoundError, NotADirectoryError):
            pass  # another run has removed the empty folder
        except OSError as error:
            raise StorageError(f"'{self._pending}' cannot be read: {error.strerror}") from None
        files = {}
        # the table last: rows that are merged meanwhile are in it
        for path in [*(self._pending / name for name in names), self._table]:
            with suppress(FileNotFoundError, NotADirectoryError):
                if not path.is_fifo():  # which would be waited for
                    files[path] = _file_id(path)
        return files

    def _read_all(self) -> tuple[pd.DataFrame, dict[Path, FileId]]:
        """Return all rows and the files that contain them; reads again if another run merges files meanwhile.

        A merge replaces the table before it deletes a small file, so files that can be read after they were listed are all rows.
        """
        for _ in _attempts():
            files = self._list_files()
            with suppress(FileNotFoundError):
                frames = self._read(files)
                self._files_read = dict(files)
                return self._merge(frames), files
        raise StorageError(f"'{self.directory}' changes faster than it can be read: too many runs write to it")

    def _read(self, paths: Iterable[Path]) -> list[pd.DataFrame]:
        """Return the valid rows as typed tables, one for all small files; notes the files with other rows."""
        import pandas as pd

        frames: list[pd.DataFrame] = []
        rows: list[dict[str, Any]] = []
        for path in paths:
            content = _content_of(path)
            if isinstance(content, list):
                small = valid_small_rows(content, self._columns, path)
                rows.extend(small)
                is_whole = len(small) == len(content)
            elif content.empty:
                continue
            else:
                frames.append(_with_types(self._columns, valid_rows(content, self._columns, path), path))
                is_whole = len(frames[-1]) == len(content)
            if not is_whole:
                self._spoilt.add(path)
        if rows:
            frames.append(_with_types(self._columns, pd.DataFrame(rows), self._pending))
        return [frame for frame in frames if not frame.empty]

    def _merge(self, frames: list[pd.DataFrame]) -> pd.DataFrame:
        """Return the newest row of each key, and store the largest ``sequence`` for :meth:`append`."""
        import pandas as pd

        if not frames:
            self._sequence = self._sequence or 0
            return pd.DataFrame(columns=self._columns.stored)
        table = pd.concat(frames, ignore_index=True) if len(frames) > 1 else frames[0].reset_index(drop=True)
        self._refuse_other_studies(table["study"])
        sequence = table["sequence"].where(table["sequence"].between(0, MAX_SEQUENCE), 0.0)
        self._sequence = max(self._sequence or 0, int(sequence.max()))
        # rows of older versions have no sequence: the clock orders them, and any row with a sequence is newer
        age = table.assign(sequence=sequence)[["sequence", "stored_at"]]
        newest_last = age.sort_values(["sequence", "stored_at"], kind="stable", na_position="first").index
        is_older = table["key"].loc[newest_last].duplicated(keep="last").sort_index()
        return table[~is_older].reset_index(drop=True) if is_older.any() else table

    # ------------------------------------------------------------------------------------------- writing

    def _in_pending(self, write: Callable[[], Any], failed: str) -> Any:
        """Return ``write()``, which writes in ``pending/``; tries again if another run removes the folder or has the lock."""
        for is_last in _attempts():
            try:
                self._pending.mkdir(parents=True, exist_ok=True)
                return write()
            except OSError as error:
                if is_last or not (isinstance(error, BlockingIOError) or _was_removed(error, self._pending)):
                    raise StorageError(f"{failed}: {error.strerror}") from None

    def _fold(self, table: pd.DataFrame, read: list[Path]) -> None:
        """Replace ``rows.parquet`` by ``table``, then delete the small files that were read.

        A file of which some rows were left out is kept under another name.
        """
        buffer = io.BytesIO()
        table.to_parquet(buffer, index=False, compression="zstd")
        for path in [self._table, *read]:
            if path in self._spoilt:
                other = self.directory / f"left_out-{uuid.uuid4().hex[:8]}{path.suffix}"
                write_whole(other, path.read_bytes())
                print(f"bench: '{path}' is kept as '{other}', since some of its rows are left out", file=sys.stderr)
        write_whole(self._table, buffer.getvalue())
        for path in read:
            path.unlink(missing_ok=True)
        self._spoilt.clear()


def sort_rows(table: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """Return the table with the rows of ``keys`` after all others, in the order of ``keys``."""
    place = {key: index for index, key in enumerate(keys)}
    position = table["key"].map(lambda key: place.get(key, -1))
    return table.iloc[position.argsort(kind="stable")].reset_index(drop=True)


def _attempts() -> Iterator[bool]:
    """Yield False for each attempt, with growing random pauses in between, and True for the last one after 60 s."""
    until, pause = time.monotonic() + PATIENCE_S, MAX_PAUSE_S / 64
    while time.monotonic() < until:
        yield False
        time.sleep(random.uniform(0.0, pause))
        pause = min(2 * pause, MAX_PAUSE_S)
    yield True


def _was_removed(error: OSError, folder: Path) -> bool:
    """Return whether an error means that a folder was removed between two steps, so that the steps can be retried.

    ``mkdir`` raises FileExistsError if the folder exists and is then removed before ``mkdir`` checks that it is one.
    """
    gone = isinstance(error, FileNotFoundError) or (isinstance(error, FileExistsError) and not os.path.lexists(folder))
    return gone and folder.parent.is_dir()


def _file_id(path: Path) -> FileId:
    status = path.stat()
    return status.st_ino, status.st_mtime_ns


def _with_types(columns: Columns, frame: pd.DataFrame, path: Path) -> pd.DataFrame:
    """Return the frame with typed columns; raises :class:`StorageError` if it is not a table of rows.

    A value of a numeric column that is not a number is an error too, since it would be stored again as missing.
    """
    if "key" not in frame or not frame["key"].map(lambda key: isinstance(key, str) and bool(key)).all():
        raise StorageError(f"'{path}' has no keys, so its rows belong to no cell; move it away to start afresh")
    typed = columns.typed(frame)
    for name in columns.of_kind("number"):
        if name not in frame or frame[name].dtype.kind in "fiub":
            continue
        if typed[name].isna().sum() > (frame[name].isna() | (frame[name].astype(str) == "")).sum():
            raise StorageError(f"'{path}' has values in its column '{name}' that are not numbers; move it away")
    return typed


def _content_of(path: Path) -> pd.DataFrame | list[dict[str, Any]]:
    """Return the table of a Parquet file or the rows of a small file; raises :class:`StorageError` if it has none."""
    try:
        return read_parquet(path) if path.suffix == ".parquet" else _rows_in(json.loads(path.read_text()))
    except FileNotFoundError:
        raise
    except Exception as error:
        kind = "Parquet" if path.suffix == ".parquet" else "JSON rows"
        raise StorageError(
            f"'{path}' cannot be read as {kind} ({printable(error)[:300]}); move it away to start afresh"
        ) from None


def _rows_in(content: Any) -> list[dict[str, Any]]:
    """Return the rows in the content of a small file; raises ValueError if it is not rows, each with its key."""
    rows = content if isinstance(content, list) else [content]
    for row in rows:
        if not isinstance(row, dict) or not isinstance(row.get("key"), str) or not row["key"]:
            raise ValueError("a row is an object with a key")
    return rows
