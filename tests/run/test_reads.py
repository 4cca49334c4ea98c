"""A row counts while all that code from outside has read for it is unchanged, and the plan says what has changed."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from classes import Fobg

from bench.experiment import keys
from bench.experiment.config import load
from bench.host import reads
from bench.model import EngineScene, registry
from bench.run.execute import Runner, Stopped, execute
from bench.run.plan import plan
from bench.run.store import Store

SCENE = '''
"""A parabola whose curvature comes from outside the file."""

import importlib.util
import json
import os
import tempfile
from dataclasses import dataclass
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import mass_package

from bench.model import FunctionScene

HERE = Path(__file__).parent
FROM_JSON = json.loads((HERE / "model.json").read_text())
ARRAY = np.load(HERE / "mass.npy")
spec = importlib.util.spec_from_file_location("of_mass", HERE / "hidden" / "of_mass.py")
of_mass = importlib.util.module_from_spec(spec)
spec.loader.exec_module(of_mass)


@dataclass(frozen=True)
class Read(FunctionScene):
    name = "read"
    neglected_effects = "all"

    def files(self):
        return [HERE / "model.xml"]

    def theta0(self):
        return np.array([1.0])

    def cost(self, xp, x):
        import of_time

        (HERE / "cache.txt").write_text(str(os.getpid()))
        (HERE / "cache.txt").read_text()
        with tempfile.NamedTemporaryFile("w+") as file:
            Path(file.name).read_text()
        subprocess_environment = {**os.environ}
        if (HERE / "override.txt").exists():
            raise ValueError("not yet")
        mass = FROM_JSON["mass"] * ARRAY[0] * of_mass.MASS * mass_package.MASS * of_time.MASS
        mass = mass * float((HERE / "mass.txt").read_text()) * float(os.environ.get("TEST_MASS", 1))
        return mass * x[0] ** 2
'''
SOURCES = {
    "mine/model.json": '{{"mass": {}}}',
    "mine/mass.txt": "{}",
    "mine/mass.npy": "array",
    "mine/hidden/of_mass.py": "MASS = {}\n",
    "path/of_time.py": "MASS = {}\n",
    "path/mass_package/__init__.py": "MASS = {}\n",
    "mine/model.xml": "<mass {}/>",
    "$TEST_MASS": "{}",
}
"""What the scene reads, and the content for a mass: at its import and later, by path, by name, and by ``files``."""
WORDS = ["scenes=[read]", "backends=[numpy]", "estimators=[fobg]", "samples=16", "repeats=4", "timing=false"]


class Plugins:
    """A folder with the scene, and runs of it."""

    def __init__(self, root):
        self.root, self.folder = root, root / "mine"
        for part in (self.folder / "hidden", root / "path" / "mass_package"):
            part.mkdir(parents=True)

    def write(self, name, mass):
        """Give one source a mass."""
        content = SOURCES[name].format(mass)
        if name.startswith("$"):
            os.environ[name[1:]] = content
        elif name.endswith(".npy"):
            np.save(self.root / name, [float(mass)])
        else:
            (self.root / name).write_text(content)

    def load(self, *words, results="out"):
        return load(
            [*WORDS, f"plugins=[{self.folder}]", f"results_dir={self.root / results}", "name=read", "workers=1", *words]
        )

    def run(self, *words, **where):
        finished = execute(self.load(*words, **where))
        return finished.rows()

    def plan(self, *words):
        made = self.load(*words)
        return plan(made, Store(made.directory, made.columns, made.study.name))


@pytest.fixture
def plugins(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "path"))
    monkeypatch.setenv("TEST_MASS", "1")
    monkeypatch.syspath_prepend(tmp_path / "path")
    made = Plugins(tmp_path)
    for name in SOURCES:
        made.write(name, 1)
    (made.folder / "read.py").write_text(SCENE)
    yield made
    for name in ("mass_package", "of_mass", "of_time"):
        sys.modules.pop(name, None)


def test_a_row_is_stale_while_something_that_it_has_read_differs(plugins, capsys):
    """Its reference too. Files that it has written, new temporary files and copies of the environment do not count."""
    before = plugins.run()
    assert list(before["status"]) == ["ok"], before["reason"][0]
    assert plugins.plan()[0].stored
    for name in SOURCES:
        for mass, said in ((20, f"{Path(name).name} changed: "), (1, "")):
            plugins.write(name, mass)
            stale = reads.Present(registry.environment()).change(before["reads"][0])
            assert said in stale if said else not stale
    plugins.write("mine/mass.txt", 20)
    (item,) = plugins.plan()
    assert not item.stored
    assert "mass.txt changed: " in item.stale
    capsys.readouterr()
    after = plugins.run()
    assert "1 stored rows are stale, and run again: " in capsys.readouterr().err
    for column in ("reference_norm", "grad_norm"):
        assert after[column][0] == pytest.approx(20 * before[column][0])
    assert after["key"][0] == before["key"][0]
    assert plugins.plan()[0].stored
    (plugins.root / "moved").mkdir()
    plugins.folder = plugins.folder.rename(plugins.root / "moved" / "mine")
    registry._folders.clear()
    registry.entries.cache_clear()
    (item,) = plugins.plan()
    assert item.stored, item.stale


@pytest.mark.parametrize("name", ["mine/read.py", "mine/mass.txt"])
def test_what_changes_during_a_run_stops_it_and_finished_rows_stay(plugins, monkeypatch, name):
    """The plugin after the plan; its data between the reference and the cells."""
    path, edits = plugins.root / name, []

    def edit(*_):
        edits.append(path.write_text(SCENE.replace("mass * x", "2 * mass * x") if name.endswith(".py") else "20"))

    monkeypatch.setattr(Store, "prepare", edit) if name.endswith(".py") else monkeypatch.setattr(
        Runner, "_measure", lambda *given, measure=Runner._measure: (edit(), measure(*given))[1]
    )
    with pytest.raises(Stopped, match=f"since .*{path.name} changed during the run"):
        plugins.run("sweep.sigma=[0.1,0.2]")
    assert edits
    store = Store(plugins.root / "out" / "read", plugins.load().columns)
    assert store.load().empty


def test_a_scene_whose_model_is_a_file_names_its_files():
    with pytest.raises(TypeError, match=r"Walker has a model_file, so it needs files\(\)"):
        type("Walker", (EngineScene,), {"model_file": lambda self: Path("walker.xml")})


def test_files_of_any_kind_of_plugin_from_outside_count(tmp_path, monkeypatch):
    monkeypatch.setattr(keys, "_fingerprints", {})
    weights = tmp_path / "weights.bin"

    @dataclass(frozen=True)
    class Weighted(Fobg):
        name = "weighted"

        def files(self):
            return [str(weights)]

    def code():
        return keys.fingerprint(Weighted())

    weights.write_bytes(b"1")
    first = code()
    weights.write_bytes(b"2")
    assert code() != first
