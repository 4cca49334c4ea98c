"""Rows and references on disk.

A finished cell is one small JSON file, written whole and renamed into place; at the end of a run the small files
are folded into ``rows.parquet``. Nothing is locked and nothing is pickled, so a run can be killed at any moment.
"""

from __future__ import annotations

import json
import math
import os
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.errors import UserError

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


@dataclass(frozen=True)
class Columns:
    """The columns of a study's rows, in order. Beside the texts and lists all are numbers."""

    names: tuple[str, ...]
    texts: tuple[str, ...] = ()
    lists: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()
    """Columns of ``rows.parquet`` that the table leaves out."""

    @classmethod
    def of(cls, *own: str, texts: tuple[str, ...] = (), lists: tuple[str, ...] = ()) -> Columns:
        """Identity, status and reason, then a study's own columns: ``own`` numbers, texts, lists."""
        names = ["experiment", *IDENTITY, "dim", "status", "reason", *own, *texts, *lists, "versions", "key"]
        return cls(tuple(names), texts, lists)

    @property
    def stored(self) -> list[str]:
        """All columns of ``rows.parquet``."""
        return [*self.names, *self.extra]

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
    extra=("variance_low", "variance_high", "compilations", "shapes"),
)  # fmt: skip
"""The columns of the main table: a contract with people's scripts."""


class Store:
    """The rows of one experiment. Raises :class:`UserError` when its directory cannot be written or read."""

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
            raise UserError(f"results directory '{self.directory}' cannot be written: {error.strerror}") from None

    def append(self, row: dict[str, Any]) -> None:
        """Store one finished cell."""
        write_whole(self._pending / f"{row['key']}.json", json.dumps(row).encode())

    def load(self) -> pd.DataFrame:
        """All stored rows, the last one of each key."""
        import pandas as pd

        frames = []
        if self._table.exists():
            try:
                frames.append(pd.read_parquet(self._table))
            except Exception as error:
                raise UserError(
                    f"'{self._table}' cannot be read as Parquet ({error}); move it away to start afresh"
                ) from None
        rows = []
        if self._pending.is_dir():
            for path in sorted(self._pending.glob("*.json"), key=lambda p: (p.stat().st_mtime_ns, p.name)):
                rows.append(json.loads(path.read_text()))
        if rows:
            frames.append(pd.DataFrame(rows))
        if not frames:
            return pd.DataFrame(columns=self._columns.stored)
        table = pd.concat([self._columns.typed(frame) for frame in frames])
        return table.drop_duplicates("key", keep="last").reset_index(drop=True)

    def compact(self) -> None:
        """Fold the small files into ``rows.parquet``."""
        import io

        taken = list(self._pending.glob("*.json")) if self._pending.is_dir() else []
        if taken:
            buffer = io.BytesIO()
            self.load().to_parquet(buffer, index=False)
            write_whole(self._table, buffer.getvalue())
            for path in taken:
                path.unlink(missing_ok=True)
        if self._pending.is_dir() and not any(self._pending.iterdir()):
            self._pending.rmdir()


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is either the old one or the new one, never a part; raises :class:`UserError` if it cannot."""
    temporary = path.with_name(f".{path.name}-{uuid.uuid4().hex}")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UserError(f"'{path}' cannot be written: {error.strerror}") from None
