"""The package works wherever it is installed and wherever a command is run."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).resolve().parents[1]
TINY = [
    "scenes=[heaviside]", "backends=[numpy]", "estimators=[fobg,reinforce]", "samples=8", "repeats=4", "name=tiny", "--quiet",
]  # fmt: skip
HIDDEN = ("jax", "jaxlib", "torch", "optimistix", "lineax", "equinox", "mujoco", "numba")
"""Libraries of the extras, which the core does without."""
BLOCK = f"""
from importlib.machinery import PathFinder
found = PathFinder.find_spec
def absent(name, path=None, target=None):
    return None if name.partition(".")[0] in {HIDDEN!r} else found(name, path, target)
PathFinder.find_spec = staticmethod(absent)
"""
"""What hides them from a process, as if they were not installed."""


def bench(*words: str, cwd: Path, path: str = "") -> subprocess.CompletedProcess[str]:
    """``python -m bench`` in a directory, from a given place or from this checkout."""
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(
        [sys.executable, "-m", "bench", *words], cwd=cwd, env=environment, capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The built wheel."""
    pytest.importorskip("hatchling")
    source = tmp_path_factory.mktemp("wheel") / "source"
    source.mkdir()
    for name in ("bench", "plugins", "conf"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "hatch_build.py"):
        shutil.copy(ROOT / name, source / name)
    script = "from hatchling.build import build_wheel; print(build_wheel('.'))"
    return source / command(sys.executable, "-c", script, cwd=source).splitlines()[-1]


def command(python: Path | str, *words: str, cwd: Path) -> str:
    """Return the output of a command that sees nothing of this checkout and has to succeed."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([str(python), *words], cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_installed_wheel_works_in_an_empty_folder_with_numpy_only(wheel, tmp_path):
    """In an environment of its own, by the command that the package installs; libraries are those of this one."""
    command(sys.executable, "-m", "venv", "--without-pip", "own", cwd=tmp_path)
    scripts = tmp_path / "own" / "bin"
    pip = ["-m", "pip", "--python", str(scripts / "python"), "install", "--quiet", "--disable-pip-version-check"]
    command(sys.executable, *pip, "--no-deps", "--no-index", str(wheel), cwd=tmp_path)
    place = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(command(scripts / "python", "-c", place, cwd=tmp_path).strip())
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    (site / "sitecustomize.py").write_text(BLOCK)
    assert (site / "bench" / "plugins" / "scenes" / "pushing.py").exists()
    assert not (site / "plugins").exists()
    where = command(scripts / "python", "-c", "import bench; print(bench.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(site)
    assert "pip install jax" in command(scripts / "diffsim-bench", "list", cwd=tmp_path)
    quick = ["+experiment=quick", "backends=[numpy]"]
    for words in ([*quick, "--quiet"], ["plan", *quick], ["report", *quick], ["--version"], ["check", "fobg"]):
        command(scripts / "diffsim-bench", *words, cwd=tmp_path)
    rows = pd.read_csv(tmp_path / "results" / "quick" / "bias_variance.csv")
    assert set(rows["status"][rows["contact"] != "complementarity"]) == {"ok"}
    assert set(rows["status"][rows["contact"] == "complementarity"]) == {"unsupported"}
    assert set(rows["backend"]) == {"numpy"}


@pytest.mark.slow
@pytest.mark.parametrize("hidden", ["plugins", "conf"])
def test_a_directory_with_packages_of_the_same_names(hidden, tmp_path):
    (tmp_path / hidden).mkdir()
    (tmp_path / hidden / "__init__.py").write_text("raise RuntimeError('the wrong one')\n")
    done = bench(*TINY, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


OWN_ESTIMATOR = """
from dataclasses import dataclass
import numpy as np
from bench.plugin import Problem, SampleMean, param

@dataclass(frozen=True)
class Half(SampleMean):
    \"\"\"Approximates grad J_sigma with a share of the first-order mean.\"\"\"

    name = "share"
    needs = frozenset({"grad"})
    unbiased = False
    share: float = param(0.5, "what the mean is multiplied by")

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        \"\"\"Gradients times the share.\"\"\"
        return self.share * problem.grad(theta, w)
"""
OWN_STUDY = """
from dataclasses import dataclass
from typing import ClassVar
import numpy as np
from bench.experiment.columns import Column, Columns, ComparisonRule
from bench.run.files import write_all
from bench.experiment.study import Study

@dataclass(frozen=True)
class CostAt(Study):
    \"\"\"Measures the cost at theta without noise.\"\"\"

    name = "cost_at"
    axes: ClassVar[tuple[str, ...]] = ("scene", "contact", "integrator", "backend")
    columns: ClassVar[Columns] = Columns.of(Column("cost_at_theta", "f at theta", comparison=ComparisonRule("exact", "cost")))

    def measure(self, cell, session):
        problem = session.problem(cell)
        w = np.zeros((problem.program.n_noise, 1))
        return {"status": "ok", "cost_at_theta": float(problem.value(problem.program.theta0, w)[0])}

    def write(self, experiment, rows):
        return write_all(experiment.directory, {"costs.csv": rows[["scene", "cost_at_theta"]].to_csv(index=False)})
"""
EXPERIMENT = """
# @package _global_
name: mine
scenes: [quadratic]
backends: [numpy]
estimators: [share]
sweep: {share: [0.5, 1.0]}
samples: 8
repeats: 4
"""


@pytest.mark.slow
def test_own_plugins_and_experiments_from_folders(tmp_path):
    (tmp_path / "own" / "estimators").mkdir(parents=True)
    (tmp_path / "own" / "estimators" / "share.py").write_text(OWN_ESTIMATOR)
    (tmp_path / "settings" / "experiment").mkdir(parents=True)
    (tmp_path / "settings" / "experiment" / "mine.yaml").write_text(EXPERIMENT)
    words = ["+experiment=mine", "plugins=own", "--config-dir", "settings", "--quiet"]
    done = bench(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    table = pd.read_csv(tmp_path / "results" / "mine" / "bias_variance.csv")
    assert sorted(table["share"]) == [0.5, 1.0]
    assert (table["status"] == "ok").all()
    assert bench("report", *words[:-1], cwd=tmp_path).returncode == 0


@pytest.mark.slow
def test_a_study_of_ones_own_from_a_folder_and_from_an_entry_point(tmp_path):
    words = [
        "study=cost_at",
        "scenes=[quadratic,pushing]",
        "backends=[numpy]",
        "sweep.sigma=[0.1,0.2]",
        "name=costs",
        "--quiet",
    ]
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "cost_at.py").write_text(OWN_STUDY)
    done = bench(*words, "plugins=own", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    first = pd.read_csv(tmp_path / "results" / "costs" / "costs.csv")
    assert len(first) == 4
    assert (tmp_path / "results" / "costs" / "report.html").stat().st_size > 0

    site = tmp_path / "site"
    information = site / "third_party-1.0.dist-info"
    information.mkdir(parents=True)
    (site / "third_party.py").write_text(OWN_STUDY)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: third-party\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[bench.plugins]\ncost_at = third_party:CostAt\n")
    done = bench(*words, "results_dir=again", cwd=tmp_path, path=str(site))
    assert done.returncode == 0, done.stderr
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "again" / "costs" / "costs.csv"), first)
    done = bench("compare", "results/costs", "again/costs", cwd=tmp_path, path=str(site))
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_the_kit_checks_a_plugin_from_a_folder(tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "share.py").write_text(OWN_ESTIMATOR)
    assert bench("check", "share", "plugins=own", cwd=tmp_path).returncode == 0
