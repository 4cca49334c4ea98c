"""Installed without an extra, the package needs NumPy and SciPy only: ``examine`` and its pytest plugin run."""

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from test_anywhere import HIDDEN, hiding, wheel  # noqa: F401

from bench.errors import SWEEPS

ROOT = Path(__file__).resolve().parents[1]
SIMULATOR = """
theta = [1.0, 0.5]
def cost(x):
    return x[0] ** 2 * x[1]
def gradient(x):
    return [2 * x[0] * x[1], x[0] ** 2]
"""
TESTS = """
import sim
def test_right(examine):
    examine(sim.cost, sim.theta, grad=sim.gradient, calls=2000)
"""
SWEEP = "pip install 'diffsim-bench[sweeps]'"


@pytest.fixture(params=["source", pytest.param("wheel", marks=pytest.mark.slow)])
def run(request, tmp_path):
    """A function that runs a Python command in a folder with :data:`SIMULATOR`, and returns its status and output."""
    place = ROOT
    if request.param == "wheel":
        place = tmp_path / "site"
        zipfile.ZipFile(request.getfixturevalue("wheel")).extractall(place)
    (tmp_path / "sitecustomize.py").write_text(hiding([*SWEEPS, *HIDDEN]))
    (tmp_path / "sim.py").write_text(SIMULATOR)
    (tmp_path / "test_sim.py").write_text(TESTS)
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{place}"}

    def call(*words):
        done = subprocess.run([sys.executable, *words], cwd=tmp_path, env=environment, capture_output=True, text=True)
        return done.returncode, done.stdout + done.stderr

    call.is_installed = place != ROOT
    return call


def test_examine_runs_by_command_and_names_the_extra_of_the_rest(run):
    examine = ["-m", "bench", "examine", "sim.py:cost", "grad=gradient", "sigma=0.01", "calls=4000", "--quiet"]
    status, said = run(*examine)
    assert status == 0, said
    assert said.startswith("Derivative: right.")
    for words in ([*examine, "save=out"], ["-m", "bench", "+experiment=quick"]):
        status, said = run(*words)
        assert (status, SWEEP in said) == (2, True), said
        assert "Traceback" not in said


def test_the_pytest_plugin_runs(run):
    plugin = [] if run.is_installed else ["-p", "bench.examine.fixture"]
    others = ["-p", "no:hydra_pytest", "-p", "no:cacheprovider"]  # Hydra has a plugin too, without which it is not here
    status, said = run("-m", "pytest", *plugin, *others, "-q", "test_sim.py")
    assert status == 0, said


def test_the_package_requires_numpy_and_scipy_and_sweeps_have_the_rest():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = [line for line in project["dependencies"] if "sys_platform" not in line]
    assert [line.partition(">")[0] for line in needed] == ["numpy", "scipy"]
    assert list(project["entry-points"]["pytest11"]) == ["bench.examine.fixture"]
    extras = project["optional-dependencies"]
    assert all("sweeps" in extras[name][0] for name in ("implicit", "engines", "fused", "training", "robots", "all"))
