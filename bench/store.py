"""Rows and references on disk.

A finished cell is one small JSON file, written whole and renamed into place; at the end of a run the small files
are folded into ``rows.parquet``. Nothing is locked and nothing is pickled, so a run can be killed at any moment.
"""

from __future__ import annotations

import json
import os
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.errors import UserError

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = [
    "experiment", "scene", "contact", "integrator", "backend", "estimator", "estimator_params", "noise",
    "horizon", "dt", "stiffness", "sigma", "smoothing", "samples", "repeats", "dim", "seed", "status", "reason",
    "grad_norm", "reference_norm", "reference_method", "reference_se", "bias", "bias_low", "bias_high",
    "bias_rel", "variance", "variance_per_sample", "rmse", "rmse_rel", "cosine", "sign_agreement",
    "finite_fraction", "model_error", "time_s", "time_iqr_s", "compile_s", "rollouts", "gradients",
    "peak_memory_mb", "dtype", "device", "versions", "key",
]  # fmt: skip
"""The columns of a row: a contract with people's scripts."""
EXTRA_COLUMNS = ("variance_low", "variance_high")
"""Columns of ``rows.parquet`` beyond the contract: the 95% interval of the variance."""
IDENTITY = [
    "scene", "contact", "integrator", "backend", "estimator", "estimator_params", "noise", "horizon", "dt",
    "stiffness", "sigma", "smoothing", "samples", "repeats", "seed", "dtype",
]  # fmt: skip
"""The columns that say which cell a row is, whatever version of the code made it."""
TEXT = [
    "experiment", "scene", "contact", "integrator", "backend", "estimator", "estimator_params", "noise", "status",
    "reason", "reference_method", "dtype", "device", "versions", "key",
]  # fmt: skip


class Store:
    """The rows of one experiment. Raises :class:`UserError` when its directory cannot be written or read."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
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
        columns = [*COLUMNS, *EXTRA_COLUMNS]
        if not frames:
            return pd.DataFrame(columns=columns)
        table = frames[0] if len(frames) == 1 else pd.concat([typed(f.reindex(columns=columns)) for f in frames])
        return typed(table.reindex(columns=columns)).drop_duplicates("key", keep="last").reset_index(drop=True)

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


def typed(table: pd.DataFrame) -> pd.DataFrame:
    """Text columns as text, the others as numbers."""
    import pandas as pd

    table = table.copy()
    for name in table.columns:
        if name in TEXT:
            table[name] = table[name].astype(object).fillna("").astype(str)
        else:
            table[name] = pd.to_numeric(table[name], errors="coerce").astype("float64")
    return table


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
