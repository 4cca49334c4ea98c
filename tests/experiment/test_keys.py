"""A key changes with what decides a cell's numbers: parameters, declared revisions, and files from outside."""

import importlib
import json
import sys
from dataclasses import replace
from types import ModuleType

import bench.plugins.fused
import pytest
from trees import ROOT

from bench.experiment import cell as cell_module
from bench.experiment import config, grid, keys
from bench.measure import noise, reference, statistics
from bench.model import Backend, PolicyScene, Scene, adjoint, program, registry
from bench.plugins import mjcf, mjx_solver

PUSH = ["scenes=[pushing]", "contacts=[penalty]", "integrators=[semi_implicit_euler]", "backends=[numpy]"]
MUJOCO = ["scenes=[pushing]", "contacts=[penalty]", "backends=[mujoco]"]
CELLS = {
    "fobg": [*PUSH, "estimators=[fobg]"],
    "reinforce": [*PUSH, "estimators=[reinforce]"],
    "windowed": [*PUSH, "estimators=[windowed]"],
    "quadratic": ["scenes=[quadratic]", "backends=[numpy]", "estimators=[fobg]"],
    "heaviside": ["scenes=[soft_heaviside]", "backends=[jax]", "estimators=[fobg]", "scene.soft_heaviside.sigma=0.1"],
    "billiard": ["scenes=[billiard]", "contacts=[softplus]", "backends=[numpy]", "estimators=[fobg]"],
    "ledge": ["scenes=[ledge]", "backends=[numpy]", "estimators=[fobg]"],
    "fused": ["scenes=[pushing]", "contacts=[penalty]", "backends=[fused]", "estimators=[fobg]"],
    "mujoco": [*MUJOCO, "estimators=[fobg]"],
    "mjx": ["scenes=[pushing]", "contacts=[penalty]", "backends=[mjx]", "estimators=[fobg]"],
    "adam": ["study=optimise", *PUSH, "estimators=[fobg]", "optimizers=[adam]"],
    "growth": ["study=growth", *PUSH],
    "policy": [
        "scenes=['cartpole_swing[policy=linear]']",
        "integrators=[rk4]",
        "backends=[numpy]",
        "estimators=[fobg]",
    ],
}
"""One cell of each kind whose keys are compared."""
PAPER = ROOT / "examples" / "cost_of_error"
EXPERIMENTS = sorted(path for folder in (ROOT / "conf", PAPER) for path in (folder / "experiment").rglob("*.yaml"))
REFERENCED = set(CELLS) - {"growth"}
PUSHED = {"fobg", "reinforce", "windowed", "fused", "mujoco", "mjx", "adam", "growth"}
MOVED = {
    ("scenes", "pushing"): PUSHED,
    ("scenes", "soft_heaviside"): {"heaviside"},
    ("contacts", "penalty"): PUSHED,
    ("estimators", "reinforce"): {"reinforce"},
    ("backends", "fused"): {"fused"},
    ("backends", "jax"): set(CELLS),
    ("backends", "mjx"): {"mjx"},
    ("optimizers", "adam"): {"adam"},
    ("policies", "linear"): {"policy"},
    ("studies", "growth"): {"growth"},
    Scene: set(CELLS),
    Backend: set(CELLS),
    PolicyScene: {"policy"},
    noise: set(CELLS),
    program: set(CELLS),
    statistics: REFERENCED,
    adjoint: {"windowed"},
    mjcf: {"mujoco", "mjx"},
    mjx_solver: {"mjx"},
    bench.plugins.fused: {"fused"},
    "closed_form": {"quadratic", "heaviside", "ledge"},
    "sampling": REFERENCED - {"quadratic", "heaviside", "ledge"},
    "quadrature": {"billiard"},
}
"""What declares a revision, with the cells whose keys change if it is raised. All references here are computed by ``jax``."""


def forget():
    """Forget the hashes that keys are computed from."""
    keys.code_of.cache_clear()
    own = (cell_module._ranked, cell_module._reference_keys)
    for cache in (keys._fingerprints, *own):
        cache.clear()


@pytest.fixture(autouse=True)
def fresh():
    forget()
    yield
    forget()


@pytest.fixture(scope="module")
def cells():
    return {name: grid.cells(config.load(words))[0] for name, words in CELLS.items()}


def keys_of(cells):
    forget()
    return {name: replace(cell).key for name, cell in cells.items()}


@pytest.mark.parametrize("what", MOVED, ids=lambda what: str(getattr(what, "__name__", what)))
def test_a_raised_revision_changes_the_keys_of_the_cells_that_use_it_and_no_other(what, cells, monkeypatch):
    before = keys_of(cells)
    if isinstance(what, ModuleType):
        monkeypatch.setattr(what, "REVISION", 2)
    elif isinstance(what, str):
        monkeypatch.setitem(reference.REVISIONS, what, 2)
    else:
        owner = registry.usable(*what) if isinstance(what, tuple) else what
        monkeypatch.setattr(owner, "revision", 2)
    after = keys_of(cells)
    assert {name for name in cells if before[name] != after[name]} == MOVED[what]


def test_a_class_that_is_new_moved_or_renamed_changes_no_key():
    assert keys.raised({"Scene": 1, "Pushing": 1}) == keys.raised({"Scene": 1, "Between": 1, "Pushed": 1}) == {}
    assert keys.raised({"Scene": 2}) != keys.raised({"Scene": 3})


OUTSIDE = """
from dataclasses import dataclass

from bench.plugins.estimators.fobg import Fobg

{imports}


@dataclass(frozen=True)
class Mine(Fobg):
    name = "{name}"
"""


@pytest.fixture
def outside(tmp_path, monkeypatch):
    """Return a function that gives the code of an estimator of another folder, whose files have these contents."""
    monkeypatch.syspath_prepend(tmp_path)

    def code(name, imports="", **files):
        (tmp_path / f"{name}.py").write_text(OUTSIDE.format(name="mine", imports=imports))
        for helper, text in files.items():
            path = tmp_path / f"{helper.replace('__', '/')}.py"
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
        monkeypatch.delitem(sys.modules, name, raising=False)
        return keys.code_of(importlib.import_module(name).Mine)

    return code


@pytest.mark.parametrize(
    ("imports", "helper"),
    [
        ("import gain", "gain"),
        ("from gain import GAIN", "gain"),
        ("import parts.gain", "parts__gain"),
        ("from parts import gain", "parts__gain"),
        ("def late():\n    import gain", "gain"),
    ],
)
def test_a_plugin_from_outside_counts_by_its_file_and_what_that_imports_from_its_folder(outside, imports, helper):
    plain = outside("first_plugin", imports, **{helper: "GAIN = 1\n"})
    assert outside("second_plugin", imports, **{helper: "GAIN = 1\n"}) == plain
    assert outside("third_plugin", imports, **{helper: "GAIN = 2\n"}) != plain
    assert outside("fourth_plugin", imports + "\nMORE = 1", **{helper: "GAIN = 1\n"}) != plain


def test_a_plugin_from_outside_whose_module_has_a_revision_counts_by_it(outside):
    first = outside("first_module", "REVISION = 1")
    assert outside("second_module", "REVISION = 1\nMORE = 1") == first
    assert json.loads(outside("third_module", "REVISION = 2")) == [{"Mine": 2}, ""]


def test_a_plugin_from_outside_has_the_revisions_of_its_bases(outside, monkeypatch):
    from bench.plugins.estimators.fobg import Fobg

    plain = outside("plain_plugin")
    monkeypatch.setattr(Fobg, "revision", 2)
    assert json.loads(outside("raised_plugin"))[0] == {"Fobg": 2}
    assert json.loads(plain)[0] == {}


def test_a_simulator_counts_by_its_file_and_what_that_imports(tmp_path):
    def key(gain):
        (tmp_path / "physics.py").write_text(f"GAIN = {gain}\n")
        (tmp_path / "mysim.py").write_text(
            "import physics\n\ntheta = [1.0]\n\n\ndef cost(theta):\n    return theta[0]\n"
        )
        words = [
            "scenes=[callable]",
            f"scene.callable.cost={tmp_path}/mysim.py:cost",
            "backends=[callable]",
            "estimators=[fobg]",
        ]
        forget()
        return grid.cells(config.load(words))[0].key

    assert key("1") == key("1") != key("2")


def test_an_estimator_whose_smoothing_fails_has_a_key_and_no_reference(cells, monkeypatch):
    def fail(self, program):
        raise ZeroDivisionError("no radius")

    cell = cells["fobg"]
    monkeypatch.setattr(type(cell.estimator), "smoothing", fail)
    assert replace(cell).key
    with pytest.raises(ZeroDivisionError, match="no radius"):
        replace(cell).smoothing()


@pytest.mark.slow
@pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda path: path.stem)
def test_stored_rows_are_those_of_the_cells_of_their_experiment(path):
    """Documents count the rows of a folder, so a row from an earlier version of the experiment would count too."""
    import pandas as pd

    folder = next(parent for parent in path.parents if parent.name == "experiment")
    experiment = config.load([f"+experiment={path.relative_to(folder).with_suffix('')}", f"plugins={PAPER}"])
    stored = ROOT / "results/standard" / experiment.name / "rows.parquet"
    if stored.exists():
        found = pd.read_parquet(stored, columns=["key"])["key"]
        assert not found.duplicated().any()
        assert set(found) <= {cell.key for cell in grid.cells(experiment)}
