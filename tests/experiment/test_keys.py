"""Every file that can decide a number is in the keys of the cells whose numbers it can decide, and in no other."""

import ast
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from trees import ROOT

import bench
import bench.model
from bench.experiment import cell as cell_module
from bench.experiment import config, grid, keys
from bench.experiment.cell import Cell
from bench.experiment.keys import HARMLESS, PROGRAM, REFERENCE, code, plugin_code
from bench.model import registry, sources
from bench.model.sources import file_of, is_below

PUSH = ["scenes=[pushing]", "contacts=[penalty]", "integrators=[semi_implicit_euler]", "backends=[numpy]"]
OPTIMISE = ["study=optimise", *PUSH, "estimators=[fobg]"]
CELLS = {
    "fobg": [*PUSH, "estimators=[fobg]"],
    "boundary": [*PUSH, "estimators=[boundary]"],
    "windowed": [*PUSH, "estimators=[windowed]"],
    "total_propagation": [*PUSH, "estimators=[total_propagation]"],
    "callable": ["scenes=[callable]", f"scene.callable.cost={ROOT}/examples/numpy_loop.py:cost", "backends=[callable]",
                 "estimators=[fobg]"],
    "adam": [*OPTIMISE, "optimizers=[adam]"],
    "cem": [*OPTIMISE, "optimizers=[cem]"],
    "ilqr": [*OPTIMISE, "optimizers=[ilqr]"],
    "dose_response": ["study=dose_response", *PUSH, "estimators=[fobg]", "optimizers=[adam]"],
    **{study: [f"study={study}", *PUSH] for study in ("backward_memory", "engines", "gradient_check", "growth", "stability", "three_errors", "twins")},
    "solver": ["study=solver", "scenes=[pushing]", "contacts=[penalty]", "backends=[mujoco]"],
    "train": ["study=train", "scenes=[cartpole_swing]", "integrators=[rk4]", "backends=[jax]", "trainers=[shac]"],
    "identify": ["study=identify", "scenes=[spring_record]", "integrators=[rk4]", "backends=[numpy]"],
}  # fmt: skip
"""One cell of every kind whose keys are compared."""
BIAS = "fobg boundary windowed total_propagation callable"
REFERENCED = f"{BIAS} engines three_errors"
ESTIMATED = f"{BIAS} engines adam cem ilqr dose_response gradient_check growth stability three_errors twins"
MOVED = {
    "measure/__init__": "",
    "measure/adequacy": "identify",
    "measure/batches": f"{REFERENCED} gradient_check",
    "measure/contacts": "gradient_check",
    "measure/gradcheck/__init__": "gradient_check",
    "measure/gradcheck/causes": "gradient_check",
    "measure/gradcheck/check": "gradient_check",
    "measure/gradcheck/direction": "gradient_check",
    "measure/gradcheck/roughness": "gradient_check",
    "measure/gradcheck/sampling": "gradient_check",
    "measure/gradcheck/verdicts": "gradient_check",
    "measure/identification": "identify",
    "measure/jumps": f"{REFERENCED} gradient_check",
    "measure/noise": f"{BIAS} backward_memory engines adam cem ilqr dose_response gradient_check growth solver three_errors twins identify train",
    "measure/performance": "identify",
    "measure/quadrature": REFERENCED,
    "measure/reference": REFERENCED,
    "measure/smoothed": REFERENCED,
    "measure/solve": "adam cem ilqr dose_response",
    "measure/statistics": f"{REFERENCED} train",
    "measure/timing": f"{BIAS} backward_memory engines solver twins",
    "model/__init__": "",
    "model/events": "boundary",
    "model/expansion": "ilqr",
    "model/adjoint": "engines windowed total_propagation ilqr",
    "model/manifold": "engines windowed total_propagation solver ilqr",
    "model/estimator": ESTIMATED,
    "model/known_solutions": "windowed adam cem ilqr dose_response identify",
    "model/optimizer": "adam cem ilqr dose_response identify",
    "model/policy": "train",
    "model/trainer": "train",
    "model/simulator/__init__": "",
    "model/simulator/clock": "callable",
    "model/simulator/example": "",
    "model/simulator/imports": "callable",
    "model/simulator/mjcf": "",
    "model/simulator/simulator": "callable",
    "model/simulator/tree": "callable",
    "run/references": REFERENCED,
    "studies/backward_memory/measure": "backward_memory",
    "studies/bias_variance/measure": BIAS,
    "studies/dose_response/measure": "dose_response",
    "studies/engines/measure": "engines",
    "studies/gradient_check/measure": "gradient_check",
    "studies/growth/measure": "growth",
    "studies/identify/measure": "identify",
    "studies/optimise/measure": "adam cem ilqr",
    "studies/solver/measure": "solver",
    "studies/stability/measure": "stability",
    "studies/three_errors/measure": "engines three_errors",
    "studies/train/measure": "train",
    "studies/twins/measure": "twins",
}
"""Files, each with the cells whose keys its code is in. A file that is not listed must be in all keys, or harmless."""
HALVES = (
    "model",
    "measure",
    "run/references",
    *(f"studies/{path.parent.name}/measure" for path in ROOT.glob("bench/studies/*/measure.py")),
)
FILES = sorted(path for path in (ROOT / "bench").rglob("*.py")
               if str(path.relative_to(ROOT / "bench").with_suffix("")).startswith(HALVES))  # fmt: skip
"""Every file of ``model`` (the user's simulator included), of ``measure``, and of each study's measuring half."""


@pytest.fixture(scope="module")
def cells() -> dict[str, Cell]:
    return {name: grid.cells(config.load(words))[0] for name, words in CELLS.items()}


files_of = cache(plugin_code)
"""The files of a plugin's code, which are the same whatever is planted: a constant imports nothing."""


def forget() -> None:
    """Forget the hashes that keys are computed from."""
    keys.module_hash.cache_clear()
    keys.plugin_hash.cache_clear()
    keys._fingerprints.clear()
    cell_module._rest.clear()


def keys_of(cells: dict[str, Cell]) -> dict[str, str]:
    """Return the keys of cells, computed anew."""
    forget()
    return {name: replace(cell).key for name, cell in cells.items()}


@pytest.fixture(scope="module")
def before(cells: dict[str, Cell]) -> dict[str, str]:
    """The keys without a planted constant."""
    return keys_of(cells)


def moved(cells: dict[str, Cell], before: dict[str, str], planted: Path, monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Return the names of the cells whose keys a constant planted in a file changes."""
    read = sources.code_hash
    with monkeypatch.context() as patch:
        patch.setattr(keys, "plugin_code", files_of)
        patch.setattr(sources, "code_hash", lambda path: read(path) + ("PLANTED = 1" if path == planted else ""))
        after = keys_of(cells)
    forget()
    return {name for name in cells if before[name] != after[name]}


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_constant_planted_in_a_file_changes_the_keys_that_it_can_decide(path, cells, before, monkeypatch):
    name = str(path.relative_to(ROOT / "bench").with_suffix(""))
    changed = moved(cells, before, path, monkeypatch)
    if is_below(module_of(path), HARMLESS):
        assert not changed
    elif name not in MOVED:
        assert changed == set(CELLS), f"{name} changes the keys of {changed} only"
    else:
        assert changed == set(MOVED[name].split())


def test_the_table_names_files_that_exist():
    names = {str(path.relative_to(ROOT / "bench").with_suffix("")) for path in FILES}
    assert set(MOVED) <= names
    assert not [
        name for name in MOVED if is_below(f"bench.{name.replace('/', '.').removesuffix('.__init__')}", HARMLESS)
    ]


def test_every_harmless_module_is_imported_by_code_that_decides_numbers(monkeypatch):
    """The list does not outlive its reasons."""
    reasons = dict(HARMLESS)
    monkeypatch.setattr(keys, "HARMLESS", {})
    plugins = [entry.plugin for table in registry.entries().values() for entry in table.values() if entry.plugin]
    reached = {*code(PROGRAM, REFERENCE), *(name for plugin in plugins for name in plugin_code(plugin))}
    for name, reason in reasons.items():
        assert file_of(name) is not None, f"there is no module {name}"
        assert any(is_below(module, [name]) for module in reached), f"nothing imports {name} any more"
        assert reason


def test_base_classes_of_another_package_count(tmp_path, monkeypatch):
    base, derived = tmp_path / "some_base.py", tmp_path / "some_scene.py"
    base.write_text("from bench.plugins.scenes.quadratic import Quadratic\n\n\nclass Base(Quadratic):\n    pass\n")
    derived.write_text("import some_base\n\n\nclass Derived(some_base.Base):\n    name = 'derived'\n")
    monkeypatch.syspath_prepend(tmp_path)
    import some_scene  # type: ignore[import-not-found]

    assert {"some_base", "some_scene", "bench.plugins.scenes.quadratic", "bench.model.scene"} <= set(
        plugin_code(some_scene.Derived)
    )


def test_a_name_of_bench_plugin_counts_as_the_module_that_defines_it(tmp_path):
    """A plugin does not rerun after a change of code that it does not use."""
    file = tmp_path / "own.py"
    names = [name for name in bench.plugin.__all__ if name in bench.model.__all__]

    def imported(package: str) -> set[str]:
        tree = ast.parse(f"from {package} import {', '.join(names)}")
        return set(sources.imports_of_tree(tree, "own", file))

    assert imported("bench.plugin") == imported("bench.model")
    assert len(imported("bench.plugin")) > 10
    assert not {"bench", "bench.plugin", "bench.model"} & imported("bench.plugin")


def test_what_a_users_file_imports_from_bench_counts(tmp_path):
    file = tmp_path / "sim.py"
    file.write_text("from bench import aggregate\n\n\ndef cost(theta):\n    return theta\n")
    curves = file_of("bench.compare.curves")
    before = keys.files_hash([file])
    with pytest.MonkeyPatch.context() as patch:
        read = sources.code_hash
        patch.setattr(sources, "code_hash", lambda path: read(path) + ("PLANTED" if path == curves else ""))
        assert keys.files_hash([file]) != before
    file.write_text("def cost(theta):\n    return theta\n")
    assert curves not in code(*keys.code("sim")).values()


STUDY = """
from dataclasses import dataclass

from bench.plugin import Column, Columns, Study

GAIN = {gain}

@dataclass(frozen=True)
class Small(Study):
    name = "small"
    axes = ("scene", "backend")
    columns = Columns.of(Column("size", "{doc}"))

    def measure(self, cell, session):
        return {{"status": "ok", "reason": "", "size": GAIN}}

    def write(self, experiment, rows):
        return [{written}]
"""


def test_a_study_of_one_file_is_known_by_all_but_what_shows_rows(tmp_path, monkeypatch):
    def hash_after(name: str, **changes: str) -> str:
        text = STUDY.format(**{"gain": "1.0", "doc": "size", "written": "", **changes})
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.syspath_prepend(tmp_path)
        return keys.plugin_hash(__import__(name).Small)

    plain = hash_after("small_study")
    assert hash_after("small_reworded", doc="length") == plain
    assert hash_after("small_shown", written="1") == plain
    assert hash_after("small_changed", gain="2.0") != plain


def test_an_estimator_whose_smoothing_fails_has_a_key_and_no_reference(cells, monkeypatch):
    def fail(self, program):
        raise ZeroDivisionError("no radius")

    cell = cells["fobg"]
    monkeypatch.setattr(type(cell.estimator), "smoothing", fail)
    assert replace(cell).key
    with pytest.raises(ZeroDivisionError, match="no radius"):
        replace(cell).smoothing()
