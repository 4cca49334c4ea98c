"""The same tasks, the same rows: on this machine, in shards, and on a Ray cluster that loses a node."""

import os
import subprocess
import sys
import time
from collections import deque
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from trees import bench

from bench.cli import main
from bench.errors import UserError
from bench.experiment import config
from bench.experiment.grid import cells
from bench.run import record
from bench.run.execute import execute, store_of
from bench.run.launchers import ray as ray_launcher
from bench.run.plan import plan

WORDS = ["scenes=[heaviside]", "backends=[numpy]", "samples=16", "repeats=4", "workers=1", "--quiet"]
SLOW = '''
"""An estimator that takes its time."""

import time
from dataclasses import dataclass

from bench.model import SampleMean


@dataclass(frozen=True)
class Slow(SampleMean):
    """The gradient, later."""

    name = "slow"
    needs = frozenset({"grad"})

    def estimate(self, problem, theta, noise):
        """Gradients."""
        time.sleep(0.4)
        return super().estimate(problem, theta, noise)

    def terms(self, problem, theta, w):
        """Gradients."""
        return problem.grad(theta, w)
'''
CLUSTER = """
import sys
from ray.cluster_utils import Cluster

small = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
cluster = Cluster(initialize_head=True, head_node_args=small | {"include_dashboard": False})
node = cluster.add_node(**small)
print(cluster.address, flush=True)
for line in sys.stdin:
    cluster.remove_node(node, allow_graceful=False)
    print("killed", flush=True)
cluster.shutdown()
"""
WHERE = ("stored_at", "sequence", "wall_s", "experiment")
"""Columns that say when and where a row was made."""


def rows(folder):
    table = pd.read_parquet(folder / "rows.parquet").sort_values("key").reset_index(drop=True)
    return table.drop(columns=[*WHERE])


# ---------------------------------------------------------------------------------------------------------- every day


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("127.0.0.1:1", r"no Ray cluster answers at 127.0.0.1:1 \(.*Connection refused\); start one"),
        ("no.such.host.invalid:6379", "no Ray cluster answers"), ("somewhere", "must be HOST:PORT"),
        ("127.0.0.1:70000", "must be HOST:PORT"),
    ],
)  # fmt: skip
def test_a_cluster_that_does_not_answer_is_refused(address, said):
    with pytest.raises(UserError, match=said):
        ray_launcher.reach(address)


def test_a_launcher_whose_library_is_absent_says_how_to_get_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main([*WORDS, "estimators=[fobg]", "launcher=ray", f"results_dir={tmp_path}"]) == 2
    assert "pip install 'diffsim-bench[ray]'" in capsys.readouterr().err


@pytest.mark.parametrize("has_token", [False, True])
def test_a_token_that_makes_a_cluster_refuse_is_named(tmp_path, monkeypatch, has_token):
    def refuse(**_):
        raise RuntimeError("the cluster has another token")

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=refuse))
    monkeypatch.setattr(ray_launcher, "reach", lambda _: None)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    if has_token:
        (tmp_path / ".ray").mkdir()
        (tmp_path / ".ray" / "auth_token").touch()
    words = ["launcher=ray", "ray.address=127.0.0.1:6379", f"results_dir={tmp_path}"]
    launcher = ray_launcher.RayLauncher(config.load([*WORDS[:-1], "estimators=[fobg]", *words]), False, "")
    with pytest.raises(
        UserError, match=r"no Ray cluster at 127\.0\.0\.1:6379: the cluster has another token"
    ) as refused:
        launcher.__enter__()
    assert ("RAY_AUTH_MODE=token" in str(refused.value)) == has_token


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


def test_a_job_is_the_first_tasks_of_one_group():
    waiting = deque([list(range(5)), [9]])
    assert [ray_launcher.first_tasks(waiting, 3) for _ in range(3)] == [[0, 1, 2], [3, 4], [9]]
    assert not waiting


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


# --------------------------------------------------------------------------------------------------------------- slow


@pytest.mark.cluster
def test_a_ray_cluster_that_loses_a_node_gives_the_table_of_a_local_run(tmp_path):
    pytest.importorskip("ray")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "slow.py").write_text(SLOW)
    words = [
        *WORDS, "estimators=[slow]", f"plugins=[{tmp_path / 'mine'}]", "timing=false",
        f"sweep.seed=[{','.join(map(str, range(24)))}]", f"results_dir={tmp_path}",
    ]  # fmt: skip
    environment = os.environ | {"RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0", "RAY_USAGE_STATS_ENABLED": "0"}
    cluster = subprocess.Popen(
        [sys.executable, "-c", CLUSTER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    )
    assert cluster.stdin is not None
    assert cluster.stdout is not None
    try:
        address = next(line.strip() for line in cluster.stdout if ":" in line)
        ray = ["launcher=ray", f"ray.address={address}", "ray.cells=6"]
        assert main([*words, "sweep.seed=[0,1]", "name=sent"]) == 0  # begun here, gone on with there
        begun = pd.read_parquet(tmp_path / "sent" / "rows.parquet").set_index("key")["stored_at"]
        run = subprocess.Popen(
            [sys.executable, "-m", "bench", *words, *ray, "name=sent"], stderr=subprocess.PIPE, text=True,
            stdout=subprocess.DEVNULL, env=environment,
        )  # fmt: skip
        for _ in range(6000):
            if len(list((tmp_path / "sent" / "pending").glob("*.json"))) >= 3:
                break
            time.sleep(0.05)
        cluster.stdin.write("kill\n")
        cluster.stdin.flush()
        assert any("killed" in line for line in cluster.stdout)
        said = run.communicate(timeout=600)[1]
        assert run.returncode == 0, said
        timed = bench(*WORDS, "estimators=[fobg]", "sweep.seed=[0,1]", *ray, "name=timed", f"results_dir={tmp_path}")
        assert timed.returncode == 0, timed.stderr
    finally:
        cluster.stdin.close()
        try:
            cluster.wait(30)
        except subprocess.TimeoutExpired:
            cluster.kill()
            cluster.wait()
        cluster.stdout.close()
    stored = pd.read_parquet(tmp_path / "sent" / "rows.parquet").set_index("key")["stored_at"]
    assert stored[begun.index].equals(begun)
    assert main([*words, "name=local", "workers=2"]) == 0
    pd.testing.assert_frame_equal(rows(tmp_path / "sent"), rows(tmp_path / "local"), check_exact=True)
    assert (rows(tmp_path / "timed")["time_s"] > 0).all()
