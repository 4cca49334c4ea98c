"""What a plugin changes in its process reaches no cell without the plugin, and JAX computes in float64 with one thread."""

import random
import re
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from changes import plugin
from threadpoolctl import ThreadpoolController, threadpool_limits

from bench.experiment.config import load
from bench.model import registry
from bench.run import tasks
from bench.run.execute import execute

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


@pytest.mark.parametrize(("backend", "kind"), [("jax", "x64"), ("numpy", "own_method")])
def test_a_change_reaches_no_other_cell_of_a_worker(tmp_path, backend, kind):
    clean = rows_of_run(tmp_path / "clean", backend, [], 0)
    rows = rows_of_run(tmp_path / "dirty", backend, [kind], 1)
    for name in ("fobg", "reinforce"):
        assert rows["mean_estimate"][name].tobytes() == clean["mean_estimate"][name].tobytes()
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
    assert re.search("this process has also run code of .*seed", rows["reason"]["changes_sqrt"])


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


FRESH = """
from bench.host.isolation import ProcessState, reduced_precision
state = ProcessState()
import jax
assert jax.config.jax_enable_x64
assert not reduced_precision()
jax.config.update("jax_enable_x64", False)
assert reduced_precision()
"""


@pytest.mark.slow
def test_jax_computes_in_float64_when_it_is_imported_later():
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
