"""Reads stored rows. Stored files may be damaged or foreign.

The name of a small file is the hash of its content: a file with another content is left out, and a line on stderr names it. A
table that cannot be read, claims more rows than a sweep can have, or has a value of a wrong type or out of range is an error
that names the file and the row.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.errors import STATUSES, StorageError, UserError, printable
from bench.experiment.columns import Columns
from bench.experiment.grid import expand, refuse_too_many

if TYPE_CHECKING:
    import pandas as pd

MAX_ROWS = 5_000_000
"""Largest number of rows of a file: five times the largest sweep."""
ALWAYS_BYTES = 1 << 28
"""Size in memory that every table may have."""
MAX_TEXT = 1_000_000
"""Length of the longest string, in characters."""
COUNTS = {"samples": 1, "repeats": 1, "seed": 0, "horizon": 0}
"""Columns of whole numbers, each with its smallest value."""
NOT_NEGATIVE = (
    "variance",
    "rmse",
    "grad_norm",
    "reference_norm",
    "reference_se",
    "bias",
    "wall_s",
    "time_s",
    "compile_s",
)
"""Columns whose numbers are at least 0."""
TABLES = ("machine", "versions", "config", "counts")
"""Entries of ``run.json`` that are tables."""
LARGEST = 2.0**53
"""Larger counts are not exact as float64, so no run has written them."""

AWAY = "move it away to start afresh"

_reported: set[Path] = set()
"""The damaged files that were named, since a command reads its files more than once."""


def read_parquet(path: Path, columns: Sequence[str] | None = None) -> pd.DataFrame:
    """Return the table in a Parquet file, or some of its columns; raises ValueError if it claims more rows or bytes than a run writes."""
    import pyarrow.parquet

    if path.is_fifo():
        raise ValueError("it is not a file")
    # read once: pandas opens a path twice, and the file may be replaced in between
    content = io.BytesIO(path.read_bytes())
    file = pyarrow.parquet.ParquetFile(content)
    metadata = file.metadata
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    n_values = sum(group.column(i).num_values for group in groups for i in range(group.num_columns))
    size = max(sum(group.total_byte_size for group in groups), 8 * n_values)  # equal values take no room in a file
    most = min(1 << 33, max(ALWAYS_BYTES, 500 * content.getbuffer().nbytes))
    if metadata.num_rows > MAX_ROWS or size > most:
        raise ValueError(f"{metadata.num_rows} rows and {size} bytes are more than a run writes")
    leaves = [metadata.schema.column(i) for i in range(metadata.num_columns)]
    texts = [leaf.path for leaf in leaves if leaf.physical_type == "BYTE_ARRAY"]
    content.seek(0)
    table = pyarrow.parquet.read_table(content, columns=columns and list(columns), read_dictionary=texts)
    # a column is freed as soon as it is converted
    frame = table.to_pandas(split_blocks=True, self_destruct=True)
    if not all(name and isinstance(name, str) for name in frame):
        raise ValueError("a column has no name")
    return frame.assign(**{name: _shared(frame[name]) for name in texts if name in frame})


def _shared(values: pd.Series) -> pd.Series:
    """Return a categorical column as strings or bytes, of which equal ones are one object: most columns have few distinct ones."""
    import pandas as pd

    if not isinstance(values.dtype, pd.CategoricalDtype):
        return values
    distinct = np.array([*values.cat.categories, math.nan], dtype=object)  # the code of a missing string is -1
    is_text = all(isinstance(value, str) for value in values.cat.categories)
    dtype = pd.StringDtype("python", na_value=math.nan) if is_text else object
    return pd.Series(pd.array(distinct[values.cat.codes.to_numpy()], dtype=dtype), index=values.index)


def read_table(path: Path, columns: Columns) -> pd.DataFrame:
    """Return the rows of ``rows.parquet`` with typed columns; raises :class:`StorageError` for a table that no run writes."""
    try:
        table = read_parquet(path)
    except FileNotFoundError:
        raise
    except Exception as error:
        raise StorageError(f"'{path}' cannot be read as Parquet ({printable(error)[:300]}); {AWAY}") from None
    return valid_rows(table, columns, path)


def read_small(paths: Sequence[Path], columns: Columns) -> tuple[pd.DataFrame, set[Path]]:
    """Return the rows of small files as one table with typed columns, and the files that are damaged: their rows are left out."""
    import pandas as pd

    contents = {path: path.read_bytes() for path in paths}
    whole = {path for path, content in contents.items() if hashlib.sha256(content).hexdigest() == path.stem}
    for path in contents.keys() - whole - _reported:
        _reported.add(path)
        print(f"bench: '{path}' is damaged: its rows are left out", file=sys.stderr)
    rows = [row for path in paths if path in whole for row in json.loads(contents[path])]
    return columns.typed(pd.DataFrame(rows, dtype=object).infer_objects()), contents.keys() - whole


def valid_rows(table: pd.DataFrame, columns: Columns, path: Path) -> pd.DataFrame:
    """Return the rows of a file with typed columns.

    Raises :class:`StorageError` with the first row whose values are of a wrong type or out of range.
    """
    if len(table) and not ("key" in table and table["key"].map(lambda key: isinstance(key, str) and bool(key)).all()):
        raise StorageError(f"'{path}' has no keys, so its rows belong to no cell; {AWAY}")
    for place, fault in _faults(table, columns):
        raise StorageError(printable(f"'{path}', row {place + 1}: {fault}; {AWAY}"))
    return columns.typed(table.infer_objects())


def _faults(table: pd.DataFrame, columns: Columns) -> Iterator[tuple[int, str]]:
    """Yield the places of values of a wrong type or out of range, or that are missing, and what is wrong with them."""
    for name in table:
        values, (holds, fault) = table[name], rule(name, columns)
        column = columns.by_name.get(name)
        if values.dtype.kind in "fiub" and (column is None or column.kind == "number"):
            is_valid: Any = _is_in_range(name, values.to_numpy(dtype=float))
        # columns of strings with rules of their own
        elif (
            str(values.dtype) == "str"
            and name not in ("status", "parameters")
            and (column is None or column.kind == "text")
        ):
            is_valid = ~(values.str.len() > MAX_TEXT).to_numpy(dtype=bool, na_value=False)
        else:
            is_valid = np.fromiter(map(holds, values), dtype=bool)
        for place in np.flatnonzero(~np.broadcast_to(is_valid, len(table))):
            yield int(place), f"{printable(name)[:60]}={printable(repr(values.iloc[place]))[:60]} {fault}"
    if "parameters" in table:
        is_described = ~table["parameters"].fillna("").isin(["", "{}"])
        # columns with a value in every row with parameters
        for name in ("status", "samples", "repeats", "seed"):
            is_missing = table[name].isna() | (table[name].astype(str) == "") if name in table else True
            for place in np.flatnonzero(is_described & is_missing):
                yield int(place), f"{name} is missing"


def rule(name: str, columns: Columns) -> tuple[Callable[[Any], bool], str]:
    """Return the check of a value of a column, and what is wrong with a value that fails it."""
    column = columns.by_name.get(name)
    if column is None:
        return lambda value: _is_scalar(value) or _is_list(value), "is neither a number nor a string nor a list"
    if name == "status":
        return lambda value: value in ("", *STATUSES), f"is not one of {', '.join(STATUSES)}"
    if name == "parameters":
        return _is_parameters, "is not an object of plugins and their values"
    if column.kind == "number":
        words = f"is not a whole number of at least {COUNTS[name]}" if name in COUNTS else "is not a number"
        words = "is negative, or is not a number" if name in NOT_NEGATIVE else words
        return lambda value: _is_missing(value) or (_is_number(value) and _is_in_range(name, value)), words
    if column.kind == "text":
        return _is_text, f"is not a string of at most {MAX_TEXT:,} characters"
    if name in columns.vectors:
        return partial(_is_list, has_texts=False), "is not a list of numbers"
    return _is_list, "is not a list of numbers or strings"


def _is_in_range(name: str, value: Any) -> Any:
    """Return whether a number, or each number of an array, is in the range of a column; missing numbers are."""
    if name in COUNTS:
        with np.errstate(invalid="ignore"):
            return (value != value) | ((value >= COUNTS[name]) & (value <= LARGEST) & (value % 1 == 0))
    return (value != value) | (value >= 0) if name in NOT_NEGATIVE else True


def _is_text(value: Any) -> bool:
    """Return whether a value is a string that can be written, or missing."""
    if _is_missing(value):
        return True
    if not isinstance(value, str) or len(value) > MAX_TEXT:
        return False
    try:
        value.encode()
    except UnicodeEncodeError:  # a lone surrogate
        return False
    return True


def _is_list(value: Any, has_texts: bool = True) -> bool:
    """Return whether a value is a flat list of numbers or, with ``has_texts``, of strings too; or missing."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        return value.ndim == 1
    if isinstance(value, list | tuple | np.ndarray):
        return all(_is_scalar(item) and (has_texts or not isinstance(item, str)) for item in value)
    return _is_missing(value)


def _is_scalar(value: Any) -> bool:
    """Return whether a value is a number that int64 or float64 can hold, a string that can be written, or None."""
    if isinstance(value, int):
        return abs(value) < 2**63
    return value is None or isinstance(value, float) or (isinstance(value, str) and _is_text(value))


def _is_parameters(text: Any) -> bool:
    return isinstance(text, str) and len(text) <= MAX_TEXT and _parses(text)


@lru_cache(maxsize=50_000)
def _parses(text: str) -> bool:
    """Return whether a string is empty or the parameters of a cell."""
    if not text:
        return True
    try:
        content = json.loads(text, parse_constant=int)  # which refuses NaN
    except (ValueError, RecursionError):
        return False
    return isinstance(content, dict) and all(_is_part(axis, part) for axis, part in content.items())


def _is_part(axis: str, part: Any) -> bool:
    """Return whether an entry of a row's parameters is a plugin with its values, theta, the reference's budget, or null."""
    if part is None:
        return True
    if not isinstance(part, dict):
        return False
    if not all(_is_scalar(value) or (isinstance(value, list) and _is_list(value)) for value in part.values()):
        return False
    if axis == "theta":
        at = part.get("at")
        return isinstance(part.get("names"), list) and (
            at is None or (isinstance(at, list) and all(map(_is_number, at)))
        )
    return axis == "reference" or isinstance(part.get("name"), str)


def _is_number(value: Any) -> bool:
    """Return whether a value is a number that float64 can hold."""
    return isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**1024)


def _is_missing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def read_record(folder: Path) -> dict[str, Any]:
    """Return the content of ``run.json`` without entries of a wrong type; empty if it is missing or no record."""
    record = read_object(folder / "run.json")
    record = {name: value for name, value in record.items() if name not in TABLES or isinstance(value, dict)}
    load = record.get("machine", {}).get("load_average")
    if load is not None and not (isinstance(load, list) and all(map(_is_number, load))):
        record["machine"] = record["machine"] | {"load_average": None}
    return record


def read_object(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file, with ? for lone surrogates, which cannot be written; empty if it has none."""
    try:
        content = json.loads("{}" if path.is_fifo() else path.read_text())
        content = json.loads(json.dumps(content, ensure_ascii=False).encode(errors="replace"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def recorded_sweep(folder: Path) -> dict[str, Any]:
    """Return the sweep in ``run.json``, or an empty one if the record is missing or invalid."""
    config = read_record(folder).get("config")
    sweep = config.get("sweep") if isinstance(config, dict) else None
    try:
        if isinstance(sweep, dict):
            refuse_too_many(sweep)
            expand(sweep)
            return sweep
    except (UserError, TypeError, AttributeError, RecursionError):
        pass
    return {}
