"""Stores rows on disk.

Rows that finish together are one small JSON file under ``pending/``; at the end of a run the small files are folded
into ``rows.parquet``. Every file is written whole under a name of its own and renamed into place, and is deleted only
by a run that has read it and written its rows into another file. So nothing is locked, a run can be killed at any
moment, and several can write to one directory: what is stored is the union of all files, the newest row of each key.
The newest is the one with the largest ``sequence``, a count that only grows: clocks may be wrong, on one of several
machines or for an hour.
"""

from __future__ import annotations

import io
import json
import os
import random
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.errors import StorageError, UserError, printable
from bench.experiment.columns import Columns
from bench.run.files import place, replace_file, sync, temporary, tidy

if TYPE_CHECKING:
    import pandas as pd

PATIENCE_S = 60.0
"""Seconds for which a directory is read again while other runs change it."""
PAUSE_S = 0.05
"""Longest pause between two tries; pauses are random, so that runs in each other's way part."""
LARGEST = 2.0**53
"""Larger counts than this are not kept exactly as float64, so no run has written them."""


class Store:
    """The rows of one experiment. Raises :class:`StorageError` when its directory cannot be written or read.

    With ``study``, a directory that holds rows of another one is refused: two studies under one name would mix.
    """

    def __init__(self, directory: Path, columns: Columns, study: str = "") -> None:
        self.directory = directory
        self._columns = columns
        self._study = study
        self._last: int | None = None
        self._seen: dict[Path, tuple[int, int]] = {}
        self._table = directory / "rows.parquet"
        self._pending = directory / "pending"
        self._claim = self._pending / ".study"

    def prepare(self) -> None:
        """Make the directory, and make sure that it can be written."""
        probe = temporary(self._pending / "probe")
        self._in_pending(lambda: probe.write_text(""), f"results directory '{self.directory}' cannot be written")
        probe.unlink(missing_ok=True)
        if self._study:
            self._claim_it()

    def _claim_it(self) -> None:
        """Have the directory belong to this study before it has rows; raises :class:`UserError` if another has it.

        The claim is made at once, like a file that is linked into place, and goes when there are rows, which say the same.
        """
        part = temporary(self._pending / "study")

        def claim() -> bool:
            try:
                part.write_text(self._study)
                place(part, self._claim)
                return True
            except FileExistsError:
                return False
            finally:
                part.unlink(missing_ok=True)

        if not self._in_pending(claim, f"'{self._claim}' cannot be made"):
            with suppress(OSError):  # whoever removes it has stored rows
                claimed = self._claim.read_text()
                if claimed not in ("", self._study):
                    raise UserError(
                        f"a run of study {printable(claimed)} has started in '{self.directory}', and this is study {self._study}: "
                        "choose another folder with name=..., or remove that one"
                    )
        if self._files() != self._seen:
            try:
                self.load()  # another run came and went since they were read
            except UserError:
                self._unclaim()
                raise

    def _unclaim(self) -> None:
        with suppress(OSError):
            if self._claim.read_text() == self._study:
                self._claim.unlink()

    def _refuse(self, studies: Iterable[str]) -> None:
        """Raise :class:`UserError` if one of these is another study."""
        others = sorted(set(studies) - {"", self._study}) if self._study else []
        if others:
            raise UserError(
                f"'{self.directory}' holds rows of study {', '.join(map(printable, others))}, and this is study {self._study}: "
                "choose another folder with name=..."
            )

    def append(self, *rows: dict[str, Any]) -> None:
        """Store finished cells: when this returns, they outlast a power cut."""
        if self._last is None:
            self.load()
        assert self._last is not None
        self._last += 1
        stamped = [row | {"stored_at": time.time(), "sequence": self._last} for row in rows]
        self._add("json", json.dumps(stamped).encode())

    def load(self) -> pd.DataFrame:
        """Load all stored rows, the newest of each key, those of ``rows.parquet`` first."""
        return self._read_all()[0]

    def compact(self, order: Sequence[str] = ()) -> None:
        """Fold the small files into ``rows.parquet``, rows of the keys in ``order`` last and in that order."""
        for _ in _tries():
            table, files = self._read_all()
            mark = files.pop(self._table, None)
            if not files or self._fold(ordered(table, order), list(files), mark):
                break
        self._tidy()

    # ------------------------------------------------------------------------------------------- reading

    def _files(self) -> dict[Path, tuple[int, int]]:
        """Return the files that hold rows, each with a mark that distinguishes it from another file of its name."""
        names: list[str] = []
        try:
            names = sorted(name for name in os.listdir(self._pending) if not name.startswith("."))
        except (FileNotFoundError, NotADirectoryError):
            pass  # another run removes it when it is empty
        except OSError as error:
            raise StorageError(f"'{self._pending}' cannot be read: {error.strerror}") from None
        marks = {}
        for path in [self._table, *(self._pending / name for name in names)]:
            with suppress(FileNotFoundError, NotADirectoryError):
                marks[path] = _mark(path)
        return marks

    def _read_all(self) -> tuple[pd.DataFrame, dict[Path, tuple[int, int]]]:
        """Read all rows, and return the files they came from; read again if another run folds files meanwhile."""
        for _ in _tries():
            files = self._files()
            try:
                frames = [_typed(self._columns, frame, path) for path, frame in _frames(files)]
            except FileNotFoundError:
                continue
            if _whole(files, self._files()):
                self._seen = dict(files)
                return self._union(frames), files
        raise StorageError(f"'{self.directory}' changes faster than it can be read: too many runs write to it")

    def _union(self, frames: list[pd.DataFrame]) -> pd.DataFrame:
        import pandas as pd

        if not frames:
            self._last = self._last or 0
            return pd.DataFrame(columns=self._columns.stored)
        table = pd.concat(frames, ignore_index=True)
        self._refuse(table["study"])
        count = table["sequence"].where(table["sequence"].between(0, LARGEST), 0.0)
        self._last = max(self._last or 0, int(count.max()))
        # rows of older versions have no count: among them the clock decides, and any counted row is newer
        place = table.assign(sequence=count)[["sequence", "stored_at"]]
        newest = place.sort_values(["sequence", "stored_at"], kind="stable", na_position="first").index
        table = table.loc[newest].drop_duplicates("key", keep="last")
        return table.sort_index().reset_index(drop=True)

    # ------------------------------------------------------------------------------------------- writing

    def _add(self, suffix: str, content: bytes) -> Path:
        path = self._pending / f"{uuid.uuid4().hex}.{suffix}"
        self._in_pending(lambda: replace_file(path, content), f"'{self._pending}' cannot be made")
        return path

    def _in_pending(self, act: Callable[[], Any], failed: str) -> Any:
        """Act in ``pending/``, a folder that another run may be removing because it is empty."""
        for last in _tries():
            try:
                self._pending.mkdir(parents=True, exist_ok=True)
                return act()
            except OSError as error:
                if last or not _removed(error, self._pending):
                    raise StorageError(f"{failed}: {error.strerror}") from None

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
            place(part, self._table)
            sync(self.directory)
        except (FileExistsError, FileNotFoundError):
            return False  # another run was faster, or has folded this very file into its own
        except OSError as error:
            raise StorageError(
                f"'{self._table}' cannot be written: {error.strerror}; its rows are in '{part}'"
            ) from None
        part.unlink(missing_ok=True)
        aside.unlink(missing_ok=True)
        return True

    def _tidy(self) -> None:
        """Remove half-written files of killed runs, and the directory of small files when it is empty."""
        tidy(self._pending)
        if self._table.exists():
            self._unclaim()
        with suppress(OSError):
            self._pending.rmdir()


def _tries() -> Iterator[bool]:
    """Yield at once and then after pauses, until patience is at its end: True for the last time."""
    until, pause = time.monotonic() + PATIENCE_S, PAUSE_S / 64
    while time.monotonic() < until:
        yield False
        time.sleep(random.uniform(0.0, pause))
        pause = min(2 * pause, PAUSE_S)
    yield True


def _removed(error: OSError, folder: Path) -> bool:
    """Whether a folder was removed between two steps, so that they can be tried again.

    ``mkdir`` says that it exists when it did, though it may be gone by the time that one looks what it is.
    """
    gone = isinstance(error, FileNotFoundError) or (isinstance(error, FileExistsError) and not os.path.lexists(folder))
    return gone and folder.parent.is_dir()


def _whole(before: Mapping[Path, tuple[int, int]], after: Mapping[Path, tuple[int, int]]) -> bool:
    """Whether all rows stood in the files listed before they were read, judged by those there are now.

    What was folded meanwhile may have been missed in both places: a listing shows a folder at no one moment. Either a
    file has gone then, or there is a new table; small files that came since are rows stored since.
    """
    came = after.keys() - before.keys()
    return before.items() <= after.items() and not any(path.suffix == ".parquet" for path in came)


def ordered(table: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """Return the table with the rows of these keys in their order, after all others."""
    place = {key: index for index, key in enumerate(keys)}
    position = table["key"].map(lambda key: place.get(key, -1))
    return table.iloc[position.argsort(kind="stable")].reset_index(drop=True)


def _mark(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_ino, status.st_mtime_ns


def _typed(columns: Columns, frame: pd.DataFrame, path: Path) -> pd.DataFrame:
    """Return the frame with its columns typed; raises :class:`StorageError` where it is no table of rows.

    A number that cannot be read would become a missing one, and be written back as that.
    """
    if "key" not in frame or not frame["key"].map(lambda key: isinstance(key, str) and bool(key)).all():
        raise StorageError(f"'{path}' has no keys, so its rows belong to no cell; move it away to start afresh")
    typed = columns.typed(frame)
    for name in columns.named("number"):
        numeric = name in frame and frame[name].dtype.kind in "fiub"
        if (
            name in frame
            and not numeric
            and typed[name].isna().sum() > (frame[name].isna() | (frame[name].astype(str) == "")).sum()
        ):
            raise StorageError(f"'{path}' has values in its column '{name}' that are no numbers; move it away")
    return typed


def _frames(paths: Iterable[Path]) -> Iterator[tuple[Path, pd.DataFrame]]:
    """Yield each table with its path; the rows of small files come last, as one table."""
    import pandas as pd

    rows: list[dict[str, Any]] = []
    for path in paths:
        try:
            if path.suffix == ".parquet":
                # opened once: a path is opened for the schema and again for the pages, and may be replaced in between
                yield path, pd.read_parquet(io.BytesIO(path.read_bytes()))
            else:
                read = json.loads(path.read_text())
                rows.extend(_rows(read if isinstance(read, list) else [read]))
                small = path
        except FileNotFoundError:
            raise
        except Exception as error:
            said = printable(error)[:300]
            what = "Parquet" if path.suffix == ".parquet" else "JSON rows"
            raise StorageError(f"'{path}' cannot be read as {what} ({said}); move it away to start afresh") from None
    if rows:
        yield small, pd.DataFrame(rows)


def _rows(read: list[Any]) -> list[dict[str, Any]]:
    """Return what a small file holds; raises ValueError where that is not rows, each with its key."""
    for row in read:
        if not isinstance(row, dict) or not isinstance(row.get("key"), str) or not row["key"]:
            raise ValueError("a row is an object with a key")
    return read
