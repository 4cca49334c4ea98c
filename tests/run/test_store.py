"""Rows outlast kills, full disks and runs side by side."""

import errno
import itertools
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pandas as pd
import pytest
from bench.plugins.studies.bias_variance.columns import COLUMNS
from pairwise import pairwise
from trees import bench

from bench.cli import main
from bench.errors import StorageError
from bench.run import files, launchers
from bench.run import store as store_module
from bench.run.store import Store

TINY = ["scenes=[heaviside]", "backends=[numpy]", "estimators=[fobg]", "samples=8", "repeats=4", "timing=false"]


def row(number, **values):
    return COLUMNS.blank() | {"key": f"{number:032x}", "status": "ok", "bias": float(number), **values}


def files_in(folder):
    """Return the names of the files in a folder and below, but not of the lock."""
    return [path.name for path in folder.rglob("*") if path.is_file() and path.name != ".lock"]


def keys(store):
    return sorted(int(key, 16) for key in store.load()["key"])


def test_lists_of_missing_numbers_come_back_as_numbers(tmp_path):
    """In a column where every list holds NaN alone, Parquet has no type for them."""
    name = COLUMNS.of_kind("list")[0]
    store = Store(tmp_path, COLUMNS)
    store.append(row(1, **{name: [math.nan, math.nan]}), row(2, **{name: []}))
    for _ in range(2):
        found = dict(zip(keys(store), store.load().sort_values("key")[name], strict=True))
        assert np.asarray(found[1], dtype=float).shape == (2,)
        assert all(math.isnan(one) for one in found[1])
        assert len(found[2]) == 0
        store.compact()


def test_rows_come_back_to_the_last_bit(tmp_path):
    store = Store(tmp_path / "s", COLUMNS)
    store.prepare()
    values = [0.1 + 0.2, 5e-324, -0.0, float("inf"), 1 / 3]
    store.append(*(row(i, bias=value) for i, value in enumerate(values)))
    store.append(row(9, bias=float("nan"), reason='a "quoted", line | ünï'))
    for _ in range(2):
        table = store.load().set_index("key")["bias"].sort_index().to_numpy()
        assert table[:5].tobytes() == np.array(values).tobytes()
        assert np.isnan(table[5])
        store.compact()
    assert files_in(tmp_path / "s") == ["rows.parquet"]


def test_rows_stay_in_the_order_of_their_file_whenever_they_were_stored(tmp_path):
    store = Store(tmp_path, COLUMNS)
    for i in (1, 2, 3):
        store.append(row(i))
    keys = [row(i)["key"] for i in (3, 1, 2)]
    store.compact(keys)
    store.append(row(4))
    assert list(store.load()["key"]) == [*keys, row(4)["key"]]
    # those asked for are last, in their order
    assert list(store_module.sort_rows(store.load(), keys[::-1])["key"]) == [row(4)["key"], *keys[::-1]]
    assert list(store_module.sort_rows(store.load(), keys[:1])["key"]) == [*keys[1:], row(4)["key"], keys[0]]
    store.compact()
    assert list(pd.read_parquet(tmp_path / "rows.parquet")["key"]) == [*keys, row(4)["key"]]


def test_columns_that_are_not_known_are_kept(tmp_path):
    """A newer version, or a study of one's own, has stored more than this one knows."""
    store = Store(tmp_path, COLUMNS)
    store.append(row(1, heat=0.5, study="mine", parameters="{}"), row(2, colour="blue"))
    for _ in range(2):
        table = store.load().set_index("key").sort_index()
        assert table["heat"].iloc[0] == 0.5
        assert math.isnan(table["heat"].iloc[1])
        assert table["colour"].iloc[1] == "blue"
        assert list(table["study"]) == ["mine", ""]
        store.compact()
    store.append(row(3))
    store.compact()
    table = pd.read_parquet(tmp_path / "rows.parquet").set_index("key").sort_index()
    assert table["heat"].tolist()[0] == 0.5
    assert table["colour"].tolist()[1] == "blue"


@pytest.mark.parametrize("step", range(1, 7))
def test_compaction_cut_short_at_any_step_loses_nothing(tmp_path, monkeypatch, step):
    """Every change of the directory is a step; after ``step`` of them the process is gone."""

    class Gone(BaseException):
        pass

    store = Store(tmp_path, COLUMNS)
    store.append(row(1), row(2))
    store.compact()
    store.append(row(3))
    store.append(row(4))
    left = [step]

    def cut(real):
        def call(*words, **more):
            left[0] -= 1
            if left[0] < 0:
                raise Gone
            return real(*words, **more)

        return call

    for name in ("replace", "fsync"):
        monkeypatch.setattr(store_module.os, name, cut(getattr(os, name)))
    monkeypatch.setattr(store_module.Path, "unlink", cut(store_module.Path.unlink))
    try:
        store.compact()
    except Gone:
        pass
    else:
        assert step >= 5, "so many steps are cut short"
    monkeypatch.undo()
    assert keys(store) == [1, 2, 3, 4]
    store.compact()
    assert keys(store) == [1, 2, 3, 4]
    assert len(pd.read_parquet(tmp_path / "rows.parquet")) == 4


def once(act):
    """Return a function that acts the first time that it is called."""
    left = [act]
    return lambda: left.pop()() if left else None


def test_a_merge_waits_for_that_of_another_run(tmp_path, monkeypatch):
    """The other one merges when this one has made its table, and has to wait until it is in place."""
    store, other, real = Store(tmp_path, COLUMNS), Store(tmp_path, COLUMNS), os.replace
    store.append(row(1))
    monkeypatch.setattr(store_module, "PATIENCE_S", 0.2)
    refused = []

    def overtake():
        with pytest.raises(StorageError, match="another run has been merging rows"):
            other.compact()
        refused.append(True)

    overtake = once(overtake)
    monkeypatch.setattr(os, "replace", lambda *words: (overtake(), real(*words))[1])
    store.compact()
    assert refused
    assert keys(store) == [1]
    assert files_in(tmp_path) == ["rows.parquet"]


def test_rows_that_are_merged_while_files_are_listed_are_read(tmp_path, monkeypatch):
    """The small file is listed, and is merged before it is read."""
    store, real = Store(tmp_path, COLUMNS), store_module.read_small
    store.append(row(1))
    overtake = once(Store(tmp_path, COLUMNS).compact)
    calls = []

    def read_small(paths, columns):
        calls.append(paths)
        if len(calls) == 1:
            overtake()
        return real(paths, columns)

    monkeypatch.setattr(store_module, "read_small", read_small)
    assert keys(store) == [1]
    assert [len(paths) for paths in calls if overtake() is None] == [1, 1, 0]


def test_a_folder_that_may_not_be_read_is_not_taken_for_an_empty_one(tmp_path, monkeypatch):
    def refuse(path):
        raise PermissionError(errno.EACCES, "Permission denied")

    Store(tmp_path, COLUMNS).append(row(1))
    monkeypatch.setattr(os, "listdir", refuse)
    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(StorageError, match="cannot be read: Permission denied"):
        Store(tmp_path, COLUMNS).load()


def test_a_file_system_without_locks_keeps_the_small_files(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(store_module.fcntl, "flock", refuse)
    store = Store(tmp_path, COLUMNS, "mine")
    store.prepare()
    store.append(row(1, study="mine"))
    with pytest.raises(StorageError, match="cannot be locked: No locks available"):
        store.compact()
    assert keys(store) == [1]
    monkeypatch.undo()
    store.compact()
    assert files_in(tmp_path) == ["rows.parquet"]


# ------------------------------------------------------------------------------------------------ commands


def test_a_linked_table_stays_a_link(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    place = tmp_path / "elsewhere" / "mine.parquet"
    (tmp_path / "rows.parquet").symlink_to(place)
    store = Store(tmp_path, COLUMNS)
    for number in (1, 2):
        store.append(row(number))
        store.compact()
    assert (tmp_path / "rows.parquet").is_symlink()
    assert len(pd.read_parquet(place)) == 2


def test_a_small_file_with_a_damaged_byte_is_left_out_and_kept(tmp_path, capsys):
    """Wherever the byte is, although most such files are still JSON with rows, as one with a misspelt column is."""
    store = Store(tmp_path, COLUMNS)
    store.append(row(1))
    store.append(row(2))
    (path,) = (path for path in (tmp_path / "pending").glob("*.json") if row(1)["key"] in path.read_text())
    content = path.read_bytes()
    for place in range(0, len(content), len(content) // 40):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        assert keys(store) == [2]
    assert f"'{path}' is damaged: its rows are left out" in capsys.readouterr().err
    damaged = path.read_bytes()
    store.compact()
    (kept,) = tmp_path.glob("left_out-*.json")
    assert kept.read_bytes() == damaged
    assert keys(store) == [2]


PLACES, VERBS = ("rows.parquet", "pending/part.parquet"), ("run", "plan", "report")


@pytest.mark.parametrize(
    ("place", "content", "verb"), pairwise(itertools.product(PLACES, (b"", b"garbage", "truncated"), VERBS))
)
def test_unreadable_file_is_named_and_left_alone(tmp_path, capsys, place, content, verb):
    path = tmp_path / "tiny" / place
    path.parent.mkdir(parents=True)
    if content == "truncated":
        whole = tmp_path / "whole"
        pd.DataFrame([row(1)]).to_parquet(whole)
        content = whole.read_bytes()[:-100]
    path.write_bytes(content)
    assert main([verb, *TINY, "name=tiny", f"results_dir={tmp_path}"]) == 2
    said = capsys.readouterr().err.strip()
    assert str(path) in said
    assert len(said.splitlines()) == 1
    assert path.read_bytes() == content


@pytest.mark.slow
@pytest.mark.parametrize("after", [0, 1, 2])
def test_disk_that_fills(tmp_path, capsys, monkeypatch, after):
    """The disk is full after so many files of rows: exit status 2, what was stored stays, and the run goes on later."""
    monkeypatch.setattr(launchers, "BATCH_S", 0.0)  # a file per row
    words = [*TINY, "name=tiny", "sweep.sigma=[0.1,0.2,0.3,0.4]", f"results_dir={tmp_path}", "workers=0"]
    real, left = files.write_whole, [after]

    def write(path, content):
        if path.parent.name == "pending" and path.suffix == ".json":
            left[0] -= 1
        if left[0] < 0:
            raise StorageError(f"'{path}' cannot be written: {os.strerror(errno.ENOSPC)}")
        real(path, content)

    for module in (files, store_module):
        monkeypatch.setattr(module, "write_whole", write)
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "No space left on device" in said
    assert "Traceback" not in said
    monkeypatch.undo()
    assert len(Store(tmp_path / "tiny", COLUMNS).load()) == after
    assert main(words) == 0
    assert len(pd.read_parquet(tmp_path / "tiny" / "rows.parquet")) == 4


# ---------------------------------------------------------------------------------------- kills and company


def start(*words):
    command = [sys.executable, "-m", "bench", *words]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def sweep(cells):
    sigmas = ",".join(f"{0.01 * (i + 1):.2f}" for i in range(cells // 2))
    words = [w for w in TINY if not w.startswith(("estimators", "samples"))]
    return [*words, "estimators=[fobg,reinforce]", "samples=4096", f"sweep.sigma=[{sigmas}]", "name=sweep", "workers=2"]


def table(directory):
    return pd.read_parquet(directory / "sweep" / "rows.parquet").drop(columns=["stored_at", "wall_s", "sequence"])


@pytest.mark.slow
def test_any_number_of_workers_gives_the_same_bytes(tmp_path):
    """References by quadrature and sampling too, on two backends, one of them compiling."""
    words = [
        "scenes=[bouncing_ball,pushing]",
        "contacts=[penalty]",
        "backends=[jax,numpy]",
        "estimators=[fobg,reinforce]",
        "scene.pushing.horizon=5",
        "scene.bouncing_ball.horizon=5",
        "samples=16",
        "repeats=4",
        "reference.samples=4096",
        "timing=false",
        "name=sweep",
        "--quiet",
    ]
    for workers in (0, 2):
        assert main([*words, f"workers={workers}", f"results_dir={tmp_path / str(workers)}"]) == 0
    csv = [(tmp_path / str(workers) / "sweep" / "bias_variance.csv").read_bytes() for workers in (0, 2)]
    assert csv[0] == csv[1]
    assert table(tmp_path / "2")["time_s"].isna().all()


@pytest.mark.parametrize("kills", [pytest.param(5, marks=pytest.mark.slow), pytest.param(20, marks=pytest.mark.full)])
def test_killed_again_and_again(tmp_path, kills):
    """A sweep is killed while it runs: no finished row is lost, and the table is that of an uninterrupted run."""
    words = sweep(10 * kills)
    assert bench(*words, f"results_dir={tmp_path / 'whole'}").returncode == 0
    store = Store(tmp_path / "cut" / "sweep", COLUMNS)
    dice = random.Random(0)
    had = set()
    for _ in range(kills):
        run = start(*words, f"results_dir={tmp_path / 'cut'}")
        had_at_start = len(had)
        deadline = time.monotonic() + 30
        while run.poll() is None and time.monotonic() < deadline and len(store.load()) < had_at_start + 5:
            time.sleep(0.02)
        time.sleep(dice.uniform(0, 0.3))
        run.send_signal(signal.SIGKILL)
        run.wait()
        have = set(store.load()["key"])
        assert had <= have
        had = have
    assert bench(*words, f"results_dir={tmp_path / 'cut'}").returncode == 0
    pd.testing.assert_frame_equal(table(tmp_path / "cut"), table(tmp_path / "whole"), check_exact=True)
    names = [tmp_path / run / "sweep" / "bias_variance.csv" for run in ("cut", "whole")]
    assert names[0].read_bytes() == names[1].read_bytes()


@pytest.mark.parametrize("change", ["rename", "remove"])
def test_rows_of_a_folder_that_goes_during_a_run_are_run_again_by_the_next(tmp_path, capsys, monkeypatch, change):
    append, calls = Store.append, []

    def append_and_lose(self, *rows):
        append(self, *rows)
        calls.append(len(rows))
        if len(calls) == 2:
            self.directory.rename(tmp_path / "elsewhere") if change == "rename" else shutil.rmtree(self.directory)

    monkeypatch.setattr(Store, "append", append_and_lose)
    monkeypatch.setattr(launchers, "BATCH_S", 0.0)
    words = [*TINY, "workers=0", "sweep.seed=[0,1,2,3]", f"results_dir={tmp_path}", "--quiet"]
    assert main(words) == 1
    assert "2 cells were run and have no row" in capsys.readouterr().err
    assert main(words) == 0
    assert calls == [1] * 6
    assert len(pd.read_parquet(tmp_path / "custom" / "rows.parquet")) == 4


def test_a_run_whose_rows_go_again_and_again_ends_with_their_number(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(Store, "append", lambda *_: None)
    assert main([*TINY, "workers=0", "sweep.seed=[0,1,2]", f"results_dir={tmp_path}", "--quiet"]) == 1
    assert "3 cells were run and have no row" in capsys.readouterr().err


def test_pipes_are_left_alone(tmp_path):
    store = Store(tmp_path, COLUMNS, "bias_variance")
    (tmp_path / "pending").mkdir()
    os.mkfifo(tmp_path / "pending" / "pipe.json")
    assert store.load().empty
    os.mkfifo(tmp_path / "pending" / ".lock")
    store.prepare()
    store.compact()
