"""A setting of the process that a plugin changes is named, and what a plugin changes reaches no other cell of a worker."""

import importlib
import random
import re
import subprocess
import sys
from contextlib import contextmanager

import jax
import numpy as np
import pandas as pd
import pytest
from changes import CHANGES, plugin
from threadpoolctl import ThreadpoolController, threadpool_limits

from bench.experiment.config import load
from bench.model import registry
from bench.model.isolation import ProcessState
from bench.run import tasks
from bench.run.execute import execute


@contextmanager
def unchanged():
    """Restore the settings that :data:`CHANGES` changes."""
    torch, special = (importlib.import_module(name) for name in ("torch", "scipy.special"))
    seeds = random.getstate(), np.random.get_state(), torch.random.get_rng_state()  # noqa: NPY002
    kind, threads, errors = torch.get_default_dtype(), torch.get_num_threads(), special.geterr()
    with np.errstate(), torch.enable_grad(), threadpool_limits():
        yield
    random.setstate(seeds[0])
    np.random.set_state(seeds[1])  # noqa: NPY002
    torch.random.set_rng_state(seeds[2])
    torch.set_default_dtype(kind)
    torch.set_num_threads(threads)
    sys.modules["scipy.special"] = special
    special.seterr(**errors)
    jax.config.update("jax_enable_x64", True)


@pytest.mark.parametrize("kind", CHANGES)
def test_a_changed_setting_is_named(kind):
    code, words = CHANGES[kind]
    with unchanged():
        state = ProcessState()
        assert state.changes() == []
        exec(code, {"np": np})
        changes = state.changes()
        state.close()
    assert words in "; ".join(changes)
    assert len(changes) <= 2


# ------------------------------------------------------------------------------------------------------------- runs

WORDS = ["scenes=[quadratic]", "samples=8", "repeats=4", "timing=false", "reference.samples=4096", "name=changed"]


def rows_of_run(folder, backend, kinds, workers):
    """Return the rows of a run of ``fobg``, changing estimators and ``reinforce``, by estimator."""
    (folder / "mine").mkdir(parents=True, exist_ok=True)
    for kind in kinds:
        (folder / "mine" / f"{kind}.py").write_text(plugin(kind))
    names = ",".join(["fobg", *(f"changes_{kind}" for kind in kinds), "reinforce"])
    words = [*WORDS, f"workers={workers}", f"backends=[{backend}]", f"estimators=[{names}]", f"results_dir={folder}"]
    execute(load([*words, f"plugins=[{folder / 'mine'}]"]))
    return pd.read_parquet(folder / "changed" / "rows.parquet").set_index("estimator")


def check_rows(rows, kinds, clean):
    """Assert that changes of settings are named, and that they change no number of the built-in cells."""
    for name in ("fobg", "reinforce"):
        assert rows["mean_estimate"][name].tobytes() == clean["mean_estimate"][name].tobytes()
        assert rows["reason"][name] == clean["reason"][name]
    for kind in set(kinds) & CHANGES.keys():
        assert CHANGES[kind][1] in rows["reason"][f"changes_{kind}"]
        assert rows["status"][f"changes_{kind}"] in ("ok", "error")


@pytest.mark.parametrize(("backend", "kinds"), [("jax", ["x64"]), ("numpy", ["seterr", "own_method"])])
def test_a_change_reaches_no_other_cell_of_a_worker(tmp_path, backend, kinds):
    clean = rows_of_run(tmp_path / "clean", backend, [], 1)
    rows = rows_of_run(tmp_path / "dirty", backend, kinds, 1)
    check_rows(rows, kinds, clean)
    assert rows["dtype"].eq("float32").sum() == (backend == "jax")
    assert not rows["reason"].str.contains("also run").any()


def test_in_this_process_cells_after_other_code_say_so(tmp_path):
    """Cells of this package come first, and every cell names the code that was imported or ran before it."""
    kinds = ["seed", "sqrt"]
    root, root_of_numpy = random.getstate(), np.sqrt
    try:
        clean = rows_of_run(tmp_path / "clean", "numpy", [], 0)
        rows = rows_of_run(tmp_path / "dirty", "numpy", kinds, 0)
    finally:
        random.setstate(root)
        np.sqrt = root_of_numpy
    for name in ("fobg", "reinforce"):
        assert rows["mean_estimate"][name].tobytes() == clean["mean_estimate"][name].tobytes()
        assert re.search("also run code of .*(seed|sqrt)", rows["reason"][name])  # and of what earlier tests imported
    later = rows["reason"]["changes_sqrt"]
    assert re.search("this process has also run code of .*seed", later)
    assert "the seed of random" in later


IMPORTED = "import numpy as np\nnp.seterr(all='raise')\n"


def test_new_processes_do_not_inherit_what_an_import_sets(tmp_path, monkeypatch):
    for name in ("BENCH_OLD", "BENCH_NEW"):
        monkeypatch.setenv(name, "before")
    monkeypatch.delenv("BENCH_NEW")
    (tmp_path / "sets.py").write_text("import os\nos.environ |= {'BENCH_OLD': 'after', 'BENCH_NEW': 'after'}\n")
    registry.add_folder(tmp_path)
    registry.entries()
    assert "sets" in {name.rpartition(".")[2] for name in registry.IMPORTED}
    assert registry.environment()["BENCH_OLD"] == "before"
    assert "BENCH_NEW" not in registry.environment()


def test_a_worker_loads_no_file_that_its_cells_do_not_need(tmp_path):
    """The change by the import of another plugin is in no row."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "imported.py").write_text(IMPORTED)
    with np.errstate():
        rows = rows_of_run(tmp_path, "numpy", ["seed"], 1)
    assert "settings changed" not in rows["reason"]["fobg"]
    assert "error state" not in rows["reason"]["changes_seed"]


FRESH = """
from bench.model.isolation import ProcessState
state = ProcessState()
import jax
assert jax.config.jax_enable_x64
state.follow()
assert state.changes() == [], state.changes()
jax.config.update("jax_enable_x64", False)
import scipy.stats  # an import after the change does not undo it unnamed
state.follow()
assert state.changes() == ["JAX's configuration (jax_enable_x64)"]
"""


@pytest.mark.slow
def test_the_settings_of_a_library_are_followed_from_its_import_on():
    subprocess.run([sys.executable, "-c", FRESH], check=True)


def counts():
    return {library.num_threads for library in ThreadpoolController().lib_controllers}


def test_cells_in_this_process_use_one_thread_and_its_own_number_comes_back(tmp_path, monkeypatch):
    seen = []
    read = tasks.measure_cell

    def measure(*given):
        seen.append(counts())
        return read(*given)

    monkeypatch.setattr(tasks, "measure_cell", measure)
    with threadpool_limits(2):
        before = counts()
        rows_of_run(tmp_path / "run", "numpy", [], 0)
        assert counts() == before
    assert seen == [{1}] * 2
