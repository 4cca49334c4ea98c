"""Stored files may be damaged or foreign: a table that no run has written is refused, with its first impossible value."""

import json
import math

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from bench.plugins.studies.bias_variance.columns import COLUMNS
from helpers import row, table

from bench.cli import main
from bench.errors import StorageError
from bench.model import registry
from bench.report import index
from bench.report.web import document
from bench.run import rows, tasks
from bench.run.store import Store

DEEP = 1000
PARTS = {
    "not_json": "{nope",
    "list": "[1,2]",
    "deep_list": "[" * DEEP + "]" * DEEP,
    "deep": '{"a":' * DEEP + "1" + "}" * DEEP,
    "number": "7",
    "null": "null",
    "part": '{"scene":[1]}',
    "no_name": '{"scene":{"sigma":1}}',
    "odd_name": '{"scene":{"name":[1]}}',
    "nan": '{"scene":{"name":"a","x":NaN}}',
    "object": '{"scene":{"name":"a","x":{"b":[1]}}}',
    "theta": '{"theta":{"names":3,"at":"x"}}',
}
SPOILT = {
    **{f"parameters_{name}": ("parameters", text, "is not an object of plugins") for name, text in PARTS.items()},
    "status": ("status", "fine", "is not one of ok, nonfinite"),
    "variance": ("variance", -1.0, "is negative"),
    "rmse": ("rmse", -1.0, "is negative"),
    "seed_missing": ("seed", math.nan, "seed is missing"),
    "seed_negative": ("seed", -1.0, "is not a whole number"),
    "seed_fraction": ("seed", 0.5, "is not a whole number"),
    "samples": ("samples", 0.0, "is not a whole number of at least 1"),
    "bytes": ("scene", b"\xff", "is not a string"),
    "number": ("scene", 3, "is not a string"),
    "word": ("bias", "large", "is not a number"),
    "long": ("reason", "x" * 2_000_000, "is not a string"),
    "strings": ("mean_estimate", ["a"], "is not a list of numbers"),
    "nested": ("mean_estimate", [[1.0]], "is not a list"),
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_table_with_an_impossible_value_is_refused_by_row_and_left_alone(tmp_path, name):
    column, value, said = SPOILT[name]
    good = table([row(seed=i) for i in range(3)])
    values = good[column].tolist()
    values[1] = value
    spoilt = good.assign(**{column: pd.Series(values, dtype=object if not isinstance(value, float) else float)})
    is_whole = name in ("bytes", "number", "word", "strings", "nested")
    if is_whole:  # a column of Parquet has one type
        spoilt = spoilt.assign(**{column: pd.Series([value] * 3, dtype=object)})
    path = tmp_path / "rows.parquet"
    spoilt.to_parquet(path)
    before, store = path.read_bytes(), Store(tmp_path, COLUMNS)
    for act in (store.load, store.compact, lambda: store.append(row())):
        with pytest.raises(StorageError) as caught:
            act()
        assert str(caught.value).startswith(f"'{path}', row {1 if is_whole else 2}: ")
        assert said in str(caught.value)
    assert path.read_bytes() == before
    assert not list((tmp_path / "pending").glob("*.json"))


@pytest.mark.parametrize("name", ["status", "samples", "repeats", "seed"])
def test_a_table_without_a_column_that_every_run_writes_is_refused(tmp_path, name):
    table([row(seed=i) for i in range(3)]).drop(columns=name).to_parquet(tmp_path / "rows.parquet")
    with pytest.raises(StorageError, match=f"row 1: {name} is missing"):
        Store(tmp_path, COLUMNS).load()


def test_an_rmse_follows_from_bias_and_variance_whatever_was_stored(tmp_path):
    rows = table([row(seed=0), row(seed=1, rmse_rel=math.nan)]).assign(
        bias=3.0, variance=16.0, reference_norm=2.0, rmse=0.0
    )
    rows.to_parquet(tmp_path / "rows.parquet")
    loaded = Store(tmp_path, COLUMNS).load()
    assert loaded["rmse"].tolist() == [5.0, 5.0]
    assert loaded["rmse_rel"].tolist() == pytest.approx([2.5, math.nan], nan_ok=True)  # a reference that may be 0


def test_a_table_without_rows_is_empty(tmp_path):
    table([row()]).iloc[:0].to_parquet(tmp_path / "rows.parquet")
    assert Store(tmp_path, COLUMNS).load().empty


UNREADABLE = {
    "rows": (pa.table({"key": ["a"] * 20}), "MAX_ROWS", 10, "20 rows and .* bytes are more than a run writes"),
    "bytes": (
        pa.table({f"column{i}": np.zeros(100_000) for i in range(40)}),
        "ALWAYS_BYTES",
        1 << 20,
        "more than a run writes",
    ),
    "names": (pa.Table.from_arrays([pa.array([1.0])] * 2, ["bias", "bias"]), "MAX_ROWS", 10, "bias"),
    "keys": (pa.table({"bias": [1.0]}), "MAX_ROWS", 10, "has no keys"),
    "no name": (pa.table({"key": ["a"], "": ["x"]}), "MAX_ROWS", 10, "a column has no name"),
}
"""Tables that no run writes: too many rows, too many equal values in a small file, two columns of one name, no keys."""


@pytest.mark.parametrize("name", UNREADABLE)
def test_a_table_that_no_run_writes_is_refused_and_never_overwritten(tmp_path, monkeypatch, name):
    written, limit, value, said = UNREADABLE[name]
    pq.write_table(written, tmp_path / "rows.parquet")
    before, store = (tmp_path / "rows.parquet").read_bytes(), Store(tmp_path, COLUMNS)
    assert len(before) < 30_000
    monkeypatch.setattr(rows, limit, value)
    for act in (store.load, store.compact, lambda: store.append(row())):
        with pytest.raises(StorageError, match=said):
            act()
    assert (tmp_path / "rows.parquet").read_bytes() == before


RECORDS = {
    "list": [],
    "counts": {"counts": "x"},
    "counts_list": {"counts": [1]},
    "counts_text": {"counts": {"ok": "x"}},
    "config": {"config": [1]},
    "sweep": {"config": {"sweep": [1]}},
    "zip": {"config": {"sweep": {"zip": 3}}},
    "question": {"question": ["a"]},
    "finished": {"finished": 5},
    "experiment": {"experiment": {"a": 1}},
    "machine": {"machine": "x"},
    "versions": {"versions": 3},
    "load": {"machine": {"load_average": ["x", None]}},
    "load_text": {"machine": {"load_average": 1}},
    "surrogate": {"machine": {"processor": "\ud800"}, "question": "\ud800"},
}


@pytest.mark.parametrize("name", RECORDS)
def test_an_odd_record_of_a_run_hides_no_experiment(tmp_path, name):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "run.json").write_text(json.dumps(RECORDS[name]))
    assert "1 experiment" in index.write(tmp_path).read_text()
    assert rows.recorded_sweep(tmp_path / "a") == {}
    document._made(rows.read_record(tmp_path / "a")).encode()


@pytest.mark.parametrize("stored_at", [["yesterday"], [1e308], pd.date_range("2020", periods=1), [None]])
def test_an_odd_date_of_a_row_does_not_end_the_index(tmp_path, stored_at):
    (tmp_path / "a").mkdir()
    table([row()]).assign(stored_at=stored_at).to_parquet(tmp_path / "a" / "rows.parquet")
    assert main(["index", str(tmp_path)]) == 0
    assert "<span>1 ok</span>" in (tmp_path / "index.html").read_text()


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [("variance", -1.0, "is negative"), ("bias", "x", "is not a number"), ("reason", 3, "is not a string")],
)
def test_a_result_that_no_file_may_hold_is_an_error_of_its_cell(name, value, said):
    """Such a row was stored, left out when it was read, and run again and again."""
    study = registry.make("studies", "bias_variance")
    assert not tasks._fault_of({"status": "ok", "variance": 1.0}, study)
    assert said in tasks._fault_of({"status": "ok", name: value}, study)
