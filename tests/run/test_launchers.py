"""The same tasks, the same rows: on this machine, on a Ray cluster that loses a node, and as jobs of Slurm."""

import importlib
import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from bench.cli import main
from bench.errors import UserError
from bench.experiment import config
from bench.run import record
from bench.run.execute import execute, store_of
from bench.run.launchers import jobs, waiting
from bench.run.tasks import Task

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


def rows(folder: Path) -> pd.DataFrame:
    table = pd.read_parquet(folder / "rows.parquet").sort_values("key").reset_index(drop=True)
    return table.drop(columns=[*WHERE])


def bench(*words: str, **more) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "bench", *words], capture_output=True, text=True, **more)


# ---------------------------------------------------------------------------------------------------------- every day


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("launcher=rai", "did you mean 'ray'"), ("ray.cell=3", "unknown setting of ray 'cell'; did you mean 'cells'"),
        ("ray.cells=0", "ray.cells=0 must be at least 1"), ("slurm.wait=0", "slurm.wait=0 must be at least 1"), ("ray.cells=x", "ray.cells='x' must be a whole number"),
        ("slurm.cluster=moab", "slurm"), ("slurm=3", "must be a table"),
    ],
)  # fmt: skip
def test_settings_of_launchers_are_checked(capsys, word, said):
    launcher = word.partition(".")[0].partition("=")[0]
    words = [] if launcher == "launcher" else [f"launcher={launcher}"]
    assert main(["plan", *WORDS, "estimators=[fobg]", *words, word]) == 2
    assert said in capsys.readouterr().err


def test_a_wait_says_what_for_and_ends(capsys, monkeypatch):
    monkeypatch.setattr(waiting, "SILENT_S", 0.0)
    patience = waiting.Patience(0.05, "ray.wait")
    patience.wait("nothing moves", "push")
    time.sleep(0.06)
    with pytest.raises(UserError, match=r"nothing moves; gave up after 0.05 s \(ray.wait\); push"):
        patience.wait("nothing moves", "push")
    assert capsys.readouterr().err == "bench: nothing moves: waiting, for at most 0.05 s (ray.wait)\n"


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("127.0.0.1:1", r"no Ray cluster answers at 127.0.0.1:1 \(Connection refused\); gave up after 0.1 s"),
        ("no.such.host.invalid:6379", "no host has that name"), ("somewhere", "must be HOST:PORT"),
        ("127.0.0.1:70000", "must be HOST:PORT"),
    ],
)  # fmt: skip
def test_a_cluster_that_does_not_answer_is_not_waited_for_long(monkeypatch, address, said):
    monkeypatch.setattr(waiting, "PAUSE_S", 0.05)
    with pytest.raises(UserError, match=said):
        waiting.reach(address, waiting.Patience(0.1, "ray.wait"))


def test_more_cores_than_a_cluster_has_are_not_waited_for_long(monkeypatch):
    ray_launcher = importlib.import_module("bench.run.launchers.ray")

    class Cluster:
        def nodes(self):
            return [{"Alive": True, "Resources": {"CPU": 2.0}}, {"Alive": False, "Resources": {"CPU": 64.0}}]

    launcher = ray_launcher.RayLauncher.__new__(ray_launcher.RayLauncher)
    launcher._ray, launcher._settings = Cluster(), {"cpus": 4.0, "wait": 0.1}
    monkeypatch.setattr(ray_launcher, "PAUSE_S", 0.02)
    with pytest.raises(UserError, match=r"ray.cpus=4 cores, and the largest node of the cluster has 2; gave up"):
        launcher._wait_for_cores()


def test_more_cores_than_this_machine_has_are_refused_when_planned(capsys, monkeypatch):
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    assert main(["plan", *WORDS, "estimators=[fobg]", "launcher=ray", "ray.cpus=4096"]) == 2
    assert "ray.cpus=4096 is more than the" in capsys.readouterr().err


@pytest.mark.parametrize("launcher", ["ray", "slurm"])
def test_a_launcher_whose_library_is_absent_says_how_to_get_it(tmp_path, capsys, monkeypatch, launcher):
    monkeypatch.setitem(sys.modules, {"ray": "ray", "slurm": "submitit"}[launcher], None)
    words = [*WORDS, "estimators=[fobg]", f"launcher={launcher}", f"results_dir={tmp_path}"]
    assert main(words) == 2
    assert f"pip install 'diffsim-bench[{launcher}]'" in capsys.readouterr().err


def test_groups_are_cut_only_as_far_as_all_slots_get_a_part():
    assert jobs.split([list(range(10)), [1]], 100, 1) == [list(range(10)), [1]]
    assert [len(part) for part in jobs.split([list(range(10))], 100, 4)] == [3, 3, 3, 1]
    assert [len(part) for part in jobs.split([list(range(10))], 4, 1)] == [4, 4, 2]


def test_the_job_script_asks_for_what_was_set(tmp_path, capsys):
    if importlib.util.find_spec("submitit") is None:
        pytest.skip("submitit is not installed")
    words = ["slurm.partition=short", "slurm.constraint=epyc", "slurm.minutes=30", "slurm.cpus=2", "memory=2g"]
    given = [*WORDS, "estimators=[fobg]", "launcher=slurm", *words, f"results_dir={tmp_path}"]
    assert main(["plan", *given, "timing=true"]) == 0
    script = capsys.readouterr().out.partition("the job script:\n")[2]
    for line in (
        "--partition=short",
        "--constraint=epyc",
        "--time=30",
        "--cpus-per-task=2",
        "--mem=5GB",
        "--exclusive",
    ):
        assert f"#SBATCH {line}\n" in script
    assert "-m submitit.core._submit" in script
    assert "export PYTHONPATH=" in script
    assert main(["plan", *given, "timing=false"]) == 0
    assert "--exclusive" not in capsys.readouterr().out


@pytest.mark.skipif(importlib.util.find_spec("submitit") is None, reason="submitit is not installed")
def test_submitit_leaves_other_peoples_logging_alone(tmp_path):
    """It sets logging up when it is imported, which closes every handler there is, and some close their streams."""
    code = (
        "import logging, sys\n"
        f"handler = logging.FileHandler({str(tmp_path / 'log')!r}); handler.acquire(); stream = handler.stream\n"
        "from bench.run.launchers import slurm\n"
        "slurm.import_submitit()\n"
        "sys.exit(stream.closed)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_row_says_which_kind_of_machine_made_it(tmp_path):
    made = config.load(
        [*WORDS[:-2], "estimators=[fobg,alpha_order]", "timing=false", "workers=0", f"results_dir={tmp_path}"]
    )
    found = execute(made).store.load()
    assert set(found["machine"]) == {record.kind_of_machine()}
    assert os.uname().nodename not in record.kind_of_machine()


def test_times_of_another_kind_of_machine_are_announced(tmp_path, capsys, monkeypatch):
    words = [*WORDS[:-2], "estimators=[fobg]", "workers=0", f"results_dir={tmp_path}", "--quiet"]
    assert main(words) == 0
    assert "timed on" not in capsys.readouterr().err
    monkeypatch.setattr(record, "kind_of_machine", lambda: "another, 8 cores, Linux")
    assert main([*words, "sweep.seed=[0,1]"]) == 0
    said = capsys.readouterr().err
    assert "1 stored rows were timed on" in said


def test_a_job_on_another_kind_of_machine_measures_nothing(tmp_path):
    import pickle

    made = config.load([*WORDS[:-2], "estimators=[fobg]", f"results_dir={tmp_path}"])
    from bench.experiment.grid import cells

    tasks = [Task(cell) for cell in cells(made)]
    job = jobs.Job((), jobs.pack(made), pickle.dumps(tasks), True, "another kind", stores=True)
    said = list(jobs.run_job(job))
    assert [place for place, _ in said] == [-1]
    assert store_of(made).load().empty
    with pytest.raises(UserError, match="times of two kinds are not mixed"):
        jobs.read_message(tasks[0], said[0][1], "another kind")


FAKE = {
    "sbatch": "echo Submitted batch job 4242",
    "srun": "exit 1",
    "sacct": "echo 'JobID|State|NodeList'; for i in 0 1 2 3; do echo 4242_$i'|PENDING|None assigned'; done",
    "scancel": 'echo "$@" >> "$CANCELLED"',
}
"""Commands of a Slurm cluster on which no job starts."""


def test_a_run_says_which_job_does_not_start_and_gives_up_after_the_limit(tmp_path, monkeypatch, capsys):
    pytest.importorskip("submitit")
    for name, text in FAKE.items():
        path = tmp_path / "bin" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setenv("CANCELLED", str(tmp_path / "cancelled"))
    monkeypatch.setattr(waiting, "SILENT_S", 0.2)
    monkeypatch.setattr(importlib.import_module("bench.run.launchers.slurm"), "TICK", 0.1)
    slurm = ["launcher=slurm", "slurm.wait=1", "slurm.cells=1", "timing=false", "name=never", f"results_dir={tmp_path}"]
    assert main([*WORDS, "estimators=[fobg]", "sweep.seed=[0,1]", *slurm]) == 2
    said = capsys.readouterr().err
    assert "none of 2 jobs has started (job 4242_0 is pending): waiting, for at most 1 s (slurm.wait)" in said
    assert "gave up after 1 s (slurm.wait); squeue shows the reason, and slurm.wait=null waits without a limit" in said
    assert "Traceback" not in said
    assert "4242" in (tmp_path / "cancelled").read_text()


# --------------------------------------------------------------------------------------------------------------- slow


@pytest.mark.slow
def test_jobs_of_submitit_give_the_rows_of_a_local_run(tmp_path):
    if importlib.util.find_spec("submitit") is None:
        pytest.skip("submitit is not installed")
    words = [
        *WORDS,
        "estimators=[fobg,alpha_order]",
        "timing=false",
        "sweep.sigma=[0.1,0.2,0.3]",
        f"results_dir={tmp_path}",
    ]
    assert main([*words, "name=local"]) == 0
    sent = ["name=sent", "launcher=slurm", "slurm.cluster=local", "slurm.cells=4", "slurm.parallel=2"]
    assert main([*words, "name=sent", "sweep.sigma=[0.2]"]) == 0  # one launcher begins, another goes on
    begun = rows(tmp_path / "sent")
    done = bench(*words, *sent)
    assert done.returncode == 0, done.stderr
    assert len(begun) == 2
    table = pd.read_parquet(tmp_path / "sent" / "rows.parquet").set_index("key")
    first = table.loc[begun["key"], "sequence"].max()
    assert (table.drop(index=begun["key"])["sequence"] > first).all()
    pd.testing.assert_frame_equal(rows(tmp_path / "sent"), rows(tmp_path / "local"), check_exact=True)
    assert not (tmp_path / "sent" / "jobs").exists()
    again = bench("plan", *words, "name=sent")
    assert "6 cells, 6 stored" in again.stdout


@pytest.mark.slow
def test_an_interrupt_prints_no_traceback_of_submitit(tmp_path):
    pytest.importorskip("submitit")
    words = [
        "scenes=[heaviside]",
        "backends=[numpy]",
        "estimators=[reinforce]",
        "samples=20000",
        "repeats=64",
        "timing=false",
    ]
    words += ["sweep.seed=range(0,400)", "launcher=slurm", "slurm.cluster=local", "slurm.cells=100", "slurm.parallel=2"]
    run = subprocess.Popen(
        [sys.executable, "-m", "bench", *words, "name=cut", f"results_dir={tmp_path}", "--quiet"],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    until = time.monotonic() + 60
    while not list(tmp_path.glob("cut/pending/*.json")) and run.poll() is None and time.monotonic() < until:
        time.sleep(0.1)
    os.killpg(run.pid, signal.SIGINT)  # as a terminal does
    said = run.communicate(timeout=60)[1]
    assert run.returncode == 130
    assert "Traceback" not in said
    assert "Continue with: python -m bench" in said


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
