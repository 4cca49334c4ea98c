"""The same tasks, the same rows, on one machine and in shards."""

import os
import subprocess
import sys

import pandas as pd
import pytest

from bench.cli import main
from bench.experiment import config
from bench.experiment.grid import cells
from bench.run import record
from bench.run.execute import execute, store_of
from bench.run.plan import plan

WORDS = ["scenes=[heaviside]", "backends=[numpy]", "samples=16", "repeats=4", "workers=1", "--quiet"]
WHERE = ("stored_at", "sequence", "wall_s", "experiment")
"""Columns that say when and where a row was made."""


def rows(folder):
    table = pd.read_parquet(folder / "rows.parquet").sort_values("key").reset_index(drop=True)
    return table.drop(columns=[*WHERE])


@pytest.mark.slow
def test_shards_at_once_one_killed_give_the_rows_of_one_run(tmp_path, capsys):
    """Cells that share a reference are in one shard; another count of shards runs nothing that is stored."""
    words = [*WORDS[:-1], "estimators=[fobg,alpha_order]", "sweep.sigma=[0.1,0.2,0.3,0.4]", f"results_dir={tmp_path}"]
    words.append("timing=false")
    assert main([*words, "name=local"]) == 0
    command = [sys.executable, "-m", "bench", *words, "name=parts"]
    runs = [subprocess.Popen([*command, f"shard={part}/3"], stdout=subprocess.DEVNULL) for part in (1, 2, 3)]
    runs[1].kill()
    assert [run.wait(120) for run in runs][::2] == [0, 0]
    assert not list((tmp_path / "parts").glob("*.csv"))
    capsys.readouterr()
    assert main([*words, "name=parts", "shard=2/3"]) == 0
    assert "cells of this shard are stored" in capsys.readouterr().out
    made = [config.load([*words, "name=parts", f"shard={part}/3"]) for part in (1, 2, 3)]
    parts = [plan(one, store_of(one)) for one in made]
    assert sum(map(len, parts)) == 8
    assert all(item.stored for part in parts for item in part)
    references = [{item.cell.reference_key for item in part} for part in parts]
    assert sum(map(len, references)) == len(set.union(*references)) == 4
    assert main(["plan", *words, "name=parts", "shard=1/5"]) == 0
    assert " 0 to run" in capsys.readouterr().out
    assert main(["report", *words, "name=parts"]) == 0
    pd.testing.assert_frame_equal(rows(tmp_path / "parts"), rows(tmp_path / "local"), check_exact=True)


@pytest.mark.parametrize("verb", [["plan"], []])
def test_an_empty_shard_says_so_and_how_many_cells_the_sweep_has(verb, tmp_path, capsys):
    words = [*WORDS[:-1], "estimators=[fobg,alpha_order]", "name=few", f"results_dir={tmp_path}"]
    keys = [cell.reference_key for cell in cells(config.load(words))]
    number = 1 + next(n for n in range(64) if n not in [int(key, 16) % 64 for key in keys])
    assert main([*verb, *words, f"shard={number}/64"]) == 0
    assert f"shard {number}/64 of few is empty: the sweep has 2 cells" in capsys.readouterr().out


def test_every_row_says_which_kind_of_machine_made_it(tmp_path):
    made = config.load(
        [*WORDS[:-2], "estimators=[fobg,alpha_order]", "timing=false", "workers=0", f"results_dir={tmp_path}"]
    )
    found = execute(made).store.load()
    assert set(found["machine"]) == {record.kind_of_machine()}
    assert os.uname().nodename not in record.kind_of_machine()


@pytest.mark.slow
def test_times_of_another_kind_of_machine_are_announced(tmp_path, capsys, monkeypatch):
    words = [*WORDS[:-2], "estimators=[fobg]", "workers=0", f"results_dir={tmp_path}", "--quiet"]
    assert main(words) == 0
    assert "timed on" not in capsys.readouterr().err
    monkeypatch.setattr(record, "kind_of_machine", lambda: "another, 8 cores, Linux")
    assert main([*words, "sweep.seed=[0,1]"]) == 0
    said = capsys.readouterr().err
    assert "1 stored rows were timed on" in said
