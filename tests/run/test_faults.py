"""Plugins that misbehave: each cell ends with the right status, the others are untouched, and no process is left."""

import os
import subprocess

import pandas as pd
import pytest
from trees import Tree, hearing_signals, processes_in, wait_for

from bench.errors import UserError
from bench.experiment.experiment import Execution
from bench.run.pool import Pool

FAULTS = '''
"""Estimators that misbehave."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass

import numpy as np

from bench.model import SampleMean


@dataclass(frozen=True)
class Faulty(SampleMean):
    """A fault when it is used."""

    needs = frozenset({"grad"})

    def fault(self, gradient):
        """What goes wrong."""
        return gradient

    def terms(self, problem, theta, w):
        """Gradients, unless something goes wrong."""
        return self.fault(problem.grad(theta, w))


def make(name, fault):
    values = {"name": name, "fault": fault, "__doc__": "A fault.", "__module__": __name__, "__annotations__": {}}
    title = name.title().replace("_", "")
    globals()[title] = dataclass(frozen=True)(type(title, (Faulty,), values))


def swallows(self, gradient):
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)
    except BaseException:
        return gradient


def bad_shape(self, gradient):
    return np.vstack([gradient, gradient])


def bad_kind(self, gradient):
    return gradient * 1j


def bad_number(self, gradient):
    gradient = gradient.copy()
    gradient[:, 3] = np.nan
    return gradient


def huge(self, gradient):
    return gradient * 1e200


def masks(self, gradient):
    return np.ma.masked_array(gradient, mask=gradient > gradient.mean())


def hangs(self, gradient):
    while True:
        time.sleep(1)


def allocates(self, gradient):
    kept = []
    while True:
        kept.append(b"x" * (1 << 26))


def shouts(self, gradient):
    print("x" * 5_000_000)
    os.write(1, b"y" * 5_000_000)
    print("\\x1b[31m[red]the end", file=sys.stderr)
    return gradient


def forks(self, gradient):
    if os.fork() == 0:
        time.sleep(600)
    subprocess.Popen(["sleep", "611"])
    return gradient


def forks_and_returns(self, gradient):
    os.fork()
    return gradient


def forks_and_dies(self, gradient):
    subprocess.Popen(["sleep", "612"], start_new_session=True)
    os.kill(os.getpid(), signal.SIGABRT)


def leaves(self, gradient):
    sys.exit(0)


def refuses(self, gradient):
    print("before the storm")
    raise ValueError("no estimate | today\\nor tomorrow")


for function in (
    bad_shape, bad_kind, bad_number, huge, masks, hangs, allocates, shouts, forks, forks_and_returns, forks_and_dies, leaves, refuses,
    swallows,
):
    make(function.__name__, function)
make("crashes", lambda self, gradient: ctypes.string_at(0))
make("vanishes", lambda self, gradient: os._exit(7))


def local():
    @dataclass(frozen=True)
    class Local(Faulty):
        name = "cannot_be_sent"

    Local.__module__ = __name__
    return Local


Hidden = local()
'''

EXPECTED = {
    "bad_shape": ("error", "returned shape"),
    "bad_kind": ("error", "complex numbers"),
    "bad_number": ("nonfinite", "theta"),
    "huge": ("ok", ""),
    "masks": ("nonfinite", "not finite"),
    "hangs": ("timeout", "no result within 20 s"),
    "allocates": ("crashed", "GiB of memory"),
    "shouts": ("ok", ""),
    "forks": ("ok", ""),
    "forks_and_returns": ("ok", ""),
    "forks_and_dies": ("crashed", "SIGABRT"),
    "leaves": ("error", "SystemExit"),
    "refuses": ("error", "ValueError: no estimate | today or tomorrow"),
    "crashes": ("crashed", "SIGSEGV"),
    "cannot_be_sent": ("error", "Can't pickle"),
    "vanishes": ("crashed", "exit status 7"),
}
LIMITS = ["timeout=20", "memory=600m"]
BASE = ["scenes=[quadratic]", "backends=[numpy]", "samples=8", "repeats=4", "timing=false"]


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    made = Tree(tmp_path_factory.mktemp("faults"))
    made.add("plugins/estimators/faults.py", FAULTS)
    return made


@pytest.fixture(scope="module")
def run(tree):
    """All faults among sound cells, run by two workers."""
    names = [name for fault in EXPECTED for name in (fault, "fobg")]
    words = [f"estimators=[{','.join(dict.fromkeys(names))},reinforce]", "name=faulty"]
    done = tree.run(*BASE, *words, *LIMITS, "workers=2", "results_dir=out")
    assert done.returncode == 1, done.stderr
    return done, pd.read_csv(tree.root / "out" / "faulty" / "bias_variance.csv")


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPECTED)
def test_fault_has_its_status_and_reason(run, name):
    status, said = EXPECTED[name]
    rows = run[1][run[1]["estimator"] == name]
    assert len(rows)
    assert set(rows["status"]) == {status}
    for reason in rows["reason"].fillna(""):
        assert said in reason
        assert "\n" not in reason


@pytest.mark.slow
def test_sound_cells_are_untouched(tree, run):
    done = tree.run(*BASE, "estimators=[fobg,reinforce]", "name=sound", "workers=0", "results_dir=out")
    assert done.returncode == 0, done.stderr
    alone = pd.read_csv(tree.root / "out" / "sound" / "bias_variance.csv")
    among = run[1][run[1]["estimator"].isin(["fobg", "reinforce"])].reset_index(drop=True)
    pd.testing.assert_frame_equal(alone.drop(columns="experiment"), among.drop(columns="experiment"), check_exact=True)


@pytest.mark.slow
def test_what_plugins_print_stays_out_of_our_output(run):
    done, rows = run
    assert "yyyy" not in done.stdout + done.stderr
    assert "\x1b[31m" not in done.stdout + done.stderr
    refused = rows[rows["estimator"] == "refuses"]["reason"]
    assert refused.str.contains("last output: before the storm").all()
    assert rows[rows["estimator"] == "crashes"]["reason"].str.contains("faults.py").all()
    assert refused.str.contains(" in refuses < faults.py:").all()
    assert rows[rows["estimator"] == "bad_number"]["reason"].str.contains("repeat 0").all()


@pytest.mark.slow
def test_no_process_is_left(tree, run):
    wait_for(lambda: not processes_in(tree.root), 5.0)


@pytest.mark.slow
def test_first_failure_can_end_the_run(tree):
    words = [*BASE, "estimators=[fobg,refuses,reinforce]", "name=stops", "workers=1", "results_dir=out"]
    done = tree.run(*words, "on_error=stop")
    assert done.returncode == 1
    assert "no estimate" in done.stderr
    assert "Continue with: python -m bench" in done.stderr
    rows = pd.read_parquet(tree.root / "out" / "stops" / "rows.parquet")
    assert "refuses" in set(rows["estimator"])
    again = tree.run(*words)
    assert again.returncode == 1
    assert len(pd.read_csv(tree.root / "out" / "stops" / "bias_variance.csv")) == 3


def start(tree, *words):
    environment = {**os.environ, "PYTHONPATH": str(tree.packages)}
    return subprocess.Popen(
        hearing_signals(*words),
        cwd=tree.root,
        env=environment,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )


@pytest.mark.slow
def test_an_interrupt_that_a_plugin_swallows_still_stops_the_run(tree):
    words = [*BASE, "estimators=[swallows,fobg]", "name=swallowed", "results_dir=out", "workers=0"]
    process = start(tree, *words)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 130
    assert "0 of 2 cells are stored" in said
    assert "Traceback" not in said


def nothing_starts(argument):
    raise RuntimeError("no handler today")


@pytest.mark.slow
def test_workers_that_cannot_start_end_the_run_at_once():
    with Pool(2, nothing_starts, None, Execution()) as pool, pytest.raises(UserError, match="no handler today"):
        list(pool.run([[1, 2], [3]]))
