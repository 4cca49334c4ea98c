"""A row counts while all that code from outside has read for it is unchanged, and the plan says what has changed."""

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bench.cli import main
from bench.experiment.config import load
from bench.model import reads
from bench.model.parameters import build
from bench.run.execute import Stopped, execute
from bench.run.plan import plan
from bench.run.store import Store

SCENE = '''
"""A parabola whose curvature comes from outside the file."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.model import FunctionScene

HERE = Path(__file__).parent
{head}


@dataclass(frozen=True)
class Read(FunctionScene):
    name = "read"
    neglected_effects = "all"

    def theta0(self):
        return np.array([1.0])

    def cost(self, xp, x):
        return {mass} * x[0] ** 2
{body}'''
SOURCES = {
    "json": ("import json\nMASS = json.loads((HERE / 'model.json').read_text())['mass']", "MASS", "model.json", '{{"mass": {}}}'),
    "text, while it runs": ("", "float((HERE / 'mass.txt').read_text())", "mass.txt", "{}"),
    "array": ("MASS = float(np.loadtxt(HERE / 'mass.dat'))", "MASS", "mass.dat", "{}"),
    "importlib": ("import importlib.util\nspec = importlib.util.spec_from_file_location('of_mass', HERE / 'hidden/of_mass.py')\n"
                  "of_mass = importlib.util.module_from_spec(spec)\nspec.loader.exec_module(of_mass)", "of_mass.MASS", "hidden/of_mass.py", "MASS = {}\n"),
    "package": ("import mass_package", "mass_package.MASS", "../path/mass_package/__init__.py", "MASS = {}\n"),
    "environment": ("", "float(os.environ.get('TEST_MASS', 1))", "$TEST_MASS", "{}"),
}  # fmt: skip
"""Where the mass comes from: code of the import, expression of the mass, file, and its content."""
WORDS = ["scenes=[read]", "backends=[numpy]", "estimators=[fobg]", "samples=16", "repeats=4", "timing=false"]


class Plugins:
    """A folder with the scene, and runs of it."""

    def __init__(self, root):
        self.root, self.folder = root, root / "mine"
        for part in (self.folder / "hidden", root / "path" / "mass_package"):
            part.mkdir(parents=True)

    def scene(self, head="", mass="1.0", body=""):
        (self.folder / "read.py").write_text(SCENE.format(head=head, mass=mass, body=body))

    def load(self, *words, results="out"):
        return load([*WORDS, f"plugins=[{self.folder}]", f"results_dir={self.root / results}", "name=read", "workers=1", *words])

    def run(self, *words, **where):
        finished = execute(self.load(*words, **where))
        return finished.rows()

    def plan(self, *words):
        made = self.load(*words)
        return plan(made, Store(made.directory, made.columns, made.study.name))


@pytest.fixture
def plugins(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "path"))
    monkeypatch.syspath_prepend(tmp_path / "path")
    yield Plugins(tmp_path)
    for name in ("mass_package", "of_mass"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("source", SOURCES)
def test_a_row_is_stale_when_what_it_has_read_changes(plugins, monkeypatch, capsys, source):
    """With the reference that it was compared with; with the old content it counts again."""
    head, mass, name, content = SOURCES[source]

    def write(value):
        if name.startswith("$"):
            monkeypatch.setenv(name[1:], content.format(value))
        else:
            (plugins.folder / name).write_text(content.format(value))

    write(1)
    plugins.scene(head, mass)
    before = plugins.run()
    assert list(before["status"]) == ["ok"], before["reason"][0]
    (item,) = plugins.plan()
    assert item.stored
    write(20)
    (item,) = plugins.plan()
    assert not item.stored
    assert Path(name).name in item.stale
    assert " changed: " in item.stale
    capsys.readouterr()
    after = plugins.run()
    assert "1 stored rows are stale" in capsys.readouterr().err
    assert after["reference_norm"][0] == pytest.approx(20 * before["reference_norm"][0])
    assert after["grad_norm"][0] == pytest.approx(20 * before["grad_norm"][0])
    assert after["key"][0] == before["key"][0]
    (item,) = plugins.plan()
    assert item.stored
