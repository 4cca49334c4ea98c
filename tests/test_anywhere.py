"""The package works wherever it is installed and wherever a command is run."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pandas as pd
import pytest
from helpers import CELLS

ROOT = Path(__file__).resolve().parents[1]
HIDDEN = ("jax", "jaxlib", "torch", "optimistix", "lineax", "equinox", "mujoco", "numba")
"""Libraries of the extras, which the core does without."""


def hiding(names):
    """Return a ``sitecustomize.py`` that hides packages from a process, as if they were not installed."""
    return f"""
from importlib.machinery import PathFinder
found = PathFinder.find_spec
def absent(cls, name, path=None, target=None):
    return None if name.partition(".")[0] in {tuple(names)!r} else found(name, path, target)
PathFinder.find_spec = classmethod(absent)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
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


def command(python, *words, cwd):
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
    (site / "sitecustomize.py").write_text(hiding(HIDDEN))
    assert (site / "bench" / "plugins" / "scenes" / "pushing.py").exists()
    assert not (site / "plugins").exists()
    where = command(scripts / "python", "-c", "import bench; print(bench.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(site)
    assert "pip install jax" in command(scripts / "diffsim-bench", "list", "backends", cwd=tmp_path)
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
    command(sys.executable, "-m", "bench", *CELLS, "--quiet", cwd=tmp_path)
