"""A command that judges says its verdict, or its status is 3: code that ends the process does not answer for it."""

import json
import os
import subprocess
import sys

import pytest

from bench.cli import main
from bench.model.simulator.imports import load_module

COST = """
import ctypes, os, signal
theta, calls = [0.4, 0.3], []
def cost(x):
    calls.append(1)
    if len(calls) == 11: {end}
    return x[0] ** 2 * x[1]
def grad(x): return [-2 * x[0] * x[1], x[0] ** 2]
"""
POOL = """
import multiprocessing
theta, loop = [0.4, 0.3], []
loop.append(loop)
def square(v): return v**2
def cost(x):
    with multiprocessing.get_context("spawn").Pool(1) as pool: return sum(pool.map(square, [float(v) for v in x]))
def grad(x): return [2 * v for v in x]
"""
SCENE = '''
"""A scene that ends the process."""

import os
from dataclasses import dataclass

import numpy as np

from bench.plugin import FunctionScene, param


@dataclass(frozen=True)
class Ends(FunctionScene):
    """Ends the process when its cost is computed.

    Approximates nothing.
    """

    name = "ends"
    sigma: float = param(0.1, "noise")

    def theta0(self):
        return np.ones(2)

    def cost(self, xp, theta):
        os._exit(0)
'''
ENDS = {"exit": "os._exit(0)", "c_exit": "ctypes.CDLL(None).exit(0)", "killed": "os.kill(os.getpid(), signal.SIGKILL)"}


def status_of(folder, *words):
    """Return the exit status and the printed errors of a command."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    command = [sys.executable, "-m", "bench", *map(str, words)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=240)
    return done.returncode, done.stderr


@pytest.mark.parametrize("end", ENDS)
def test_a_cost_that_ends_the_process_is_not_right(end, tmp_path):
    (tmp_path / "mine.py").write_text(COST.format(end=ENDS[end]))
    status, said = status_of(tmp_path, "examine", "mine.py:cost", "grad=grad", "--quiet")
    assert status == 3
    assert "before a verdict" in said


@pytest.mark.slow
def test_the_status_of_a_verdict_and_of_bad_input_arrives(tmp_path):
    (tmp_path / "mine.py").write_text(COST.format(end="pass"))
    assert status_of(tmp_path, "examine", "mine.py:cost", "grad=grad", "--quiet")[0] == 1
    assert status_of(tmp_path, "examine", "mine.py:nothing")[0] == 2


@pytest.mark.slow
def test_a_scene_that_ends_the_process_is_not_right(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "ends.py").write_text(SCENE)
    words = ["gradcheck", "ends", "workers=0", f"plugins={tmp_path / 'mine'}", f"results_dir={tmp_path / 'results'}"]
    assert status_of(tmp_path, *words)[0] == 3


@pytest.mark.slow
def test_processes_of_a_cost_find_its_file(tmp_path):
    (tmp_path / "pool.py").write_text(POOL)
    words = ["examine", "pool.py:cost", "grad=grad", "calls=20"]
    done = subprocess.run(
        [sys.executable, "-m", "bench", *words], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


def test_a_theta_that_contains_itself_is_bad_input(tmp_path, capsys):
    (tmp_path / "pool.py").write_text(POOL)
    assert main(["examine", f"{tmp_path / 'pool.py'}:cost", "theta=loop", "grad=grad", "calls=20"]) == 2
    assert "contains itself" in capsys.readouterr().err


def test_a_file_named_like_a_library_is_loaded_beside_it(tmp_path):
    (tmp_path / "json.py").write_text("OWN = 1\n")
    assert load_module(str(tmp_path / "json.py")).OWN == 1
    assert json.dumps([1]) == "[1]"
    assert sys.modules["json"] is json
