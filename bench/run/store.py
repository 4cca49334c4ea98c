"""Stores rows on disk.

Rows that finish together are one small JSON file under ``pending/``, whose name is the hash of its content: a damaged file is
left out, and its cells run again. At the end of a run the small files are merged
into ``rows.parquet``, by one run at a time, which holds a lock (``flock``). Every file is written completely under a unique
name and then renamed into place, and a small file is deleted only after its rows are in the table. So a run can be killed at
any moment, and several runs can write to one directory: the stored rows are the newest row of each key in all files. The
newest row has the largest ``sequence``, a counter that only grows. Clocks are not used, since they differ between machines
and may be wrong for an hour. Reading and adding rows need no lock. Where the file system has none, small files stay.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import json
import os
import random
import sys
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.errors import StorageError, UserError, printable
from bench.experiment.columns import Columns
from bench.run.files import make_directory, write_whole
from bench.run.rows import LARGEST, read_small, read_table

if TYPE_CHECKING:
    import pandas as pd

PATIENCE_S = 60.0
"""Seconds for which a merge is waited for, and reads are retried while other runs merge files."""


class Store:
    """The rows of one experiment. Raises :class:`StorageError` if its directory cannot be written or read.

    With ``study``, a directory that contains rows of another study is refused, so that two studies do not mix.
    """

    def __init__(self, directory: Path, columns: Columns, study: str = "") -> None:
        self.directory = directory
        self._columns = columns
        self._study = study
        self._sequence: int | None = None
        self.left_out: set[Path] = set()
        """The damaged files whose rows :meth:`load` has left out."""
        self._table = directory / "rows.parquet"
        self._pending = directory / "pending"

    def prepare(self) -> None:
        """Create the directory, and check that it can be written and has no rows of another study."""
        make_directory(self._pending)
        probe = self._pending / f".{uuid.uuid4().hex}"
        write_whole(probe, b"")
        probe.unlink(missing_ok=True)
        self.load()

    def append(self, *rows: dict[str, Any]) -> None:
        """Store the rows of finished cells. On return, the rows survive a power failure."""
        if self._sequence is None:
            self.load()
        assert self._sequence is not None
        self._sequence += 1
        stamped = [row | {"stored_at": time.time(), "sequence": self._sequence} for row in rows]
        make_directory(self._pending)
        content = json.dumps(stamped).encode()
        write_whole(self._pending / f"{hashlib.sha256(content).hexdigest()}.json", content)

    def load(self) -> pd.DataFrame:
        """Return the newest stored row of each key; rows of ``rows.parquet`` come first."""
        rows, _, self.left_out = self._read_all()
        return rows

    def compact(self, order: Sequence[str] = ()) -> None:
        """Merge the small files into ``rows.parquet``; rows of the keys in ``order`` come last, in that order.

        A damaged file is kept under another name.
        """
        with self._locked():
            rows, small, damaged = self._read_all()
            if not small:
                return
            content = io.BytesIO()
            sort_rows(rows, order).to_parquet(content, index=False, compression="zstd")
            for path in damaged:
                kept = self.directory / f"left_out-{uuid.uuid4().hex[:8]}{path.suffix}"
                write_whole(kept, path.read_bytes())
                print(f"bench: '{path}' is kept as '{kept}'", file=sys.stderr)
            write_whole(self._table, content.getvalue())
            for path in small:
                path.unlink(missing_ok=True)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the lock of the directory."""
        make_directory(self._pending)
        # a pipe would be waited for if it were opened for writing alone
        with (self._pending / ".lock").open("a+b", buffering=0) as file:
            try:
                for _ in _attempts():
                    with suppress(BlockingIOError):
                        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                        break
                else:
                    raise StorageError(f"another run has been merging rows in '{self.directory}' for {PATIENCE_S:g} s")
            except OSError as error:
                raise StorageError(f"'{self._pending}' cannot be locked: {error.strerror}") from None
            yield

    def _read_all(self) -> tuple[pd.DataFrame, list[Path], set[Path]]:
        """Return the newest row of each key, the small files, and those that are damaged.

        A merge replaces the table before it deletes a small file. So the table is read last, and all is read again if a small
        file has gone meanwhile.
        """
        for _ in _attempts():
            with suppress(FileNotFoundError):
                small = self._small_files()
                rows, damaged = read_small([path for path in small if path.suffix != ".parquet"], self._columns)
                tables = [path for path in small if path.suffix == ".parquet"]
                parts = [rows, *(read_table(path, self._columns) for path in tables)]
                if self._table.is_file():
                    parts.insert(0, read_table(self._table, self._columns))
                return self._newest([rows for rows in parts if len(rows)]), small, damaged
        raise StorageError(f"'{self.directory}' changes faster than it can be read: too many runs write to it")

    def files(self) -> list[Path]:
        """Return the files with rows: ``rows.parquet``, if there is one, and the small files."""
        return [*[self._table] * self._table.is_file(), *self._small_files()]

    def _small_files(self) -> list[Path]:
        names: list[str] = []
        try:
            names = sorted(name for name in os.listdir(self._pending) if not name.startswith("."))
        except (FileNotFoundError, NotADirectoryError):
            pass
        except OSError as error:
            raise StorageError(f"'{self._pending}' cannot be read: {error.strerror}") from None
        # a file that is merged meanwhile is in the table, and a pipe would be waited for
        return [path for name in names if (path := self._pending / name).is_file()]

    def _newest(self, frames: list[pd.DataFrame]) -> pd.DataFrame:
        """Return the newest row of each key, and note the largest ``sequence`` for :meth:`append`; refuses rows of other studies."""
        import pandas as pd

        self._sequence = self._sequence or 0
        if not frames:
            return pd.DataFrame(columns=self._columns.stored)
        table = pd.concat(frames, ignore_index=True) if len(frames) > 1 else frames[0].reset_index(drop=True)
        others = sorted({*table["study"]} - {"", self._study}) if self._study else []
        if others:
            raise UserError(
                f"'{self.directory}' holds rows of study {', '.join(map(printable, others))}, and this is study {self._study}: "
                "choose another folder with name=..."
            )
        sequence = table["sequence"].where(table["sequence"].between(0, LARGEST), 0.0)
        self._sequence = max(self._sequence, int(sequence.max()))
        newest_last = sequence.sort_values(kind="stable").index
        is_older = table["key"].loc[newest_last].duplicated(keep="last").sort_index()
        return table[~is_older].reset_index(drop=True) if is_older.any() else table


def sort_rows(table: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """Return the table with the rows of ``keys`` after all others, in the order of ``keys``."""
    place = {key: index for index, key in enumerate(keys)}
    position = table["key"].map(lambda key: place.get(key, -1))
    return table.iloc[position.argsort(kind="stable")].reset_index(drop=True)


def _attempts() -> Iterator[None]:
    """Yield for each attempt, for 60 s, with random pauses in between."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        yield
        # longest pause in seconds between two attempts. Pauses are random, so that two runs do not disturb each
        # other again
        time.sleep(random.uniform(0.0, 0.05))
