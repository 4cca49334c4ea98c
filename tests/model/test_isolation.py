"""A change of the process by a plugin is named and undone, and reaches no other cell."""

import decimal
import importlib
import os
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
from bench.model.isolation import State
from bench.run import tasks
from bench.run.execute import execute

LIBRARIES = (
    "jax.numpy", "scipy.fft", "scipy.linalg", "scipy.optimize", "scipy.special", "torch", "bench.measure.statistics",
    "bench.plugins.estimators.fobg", "bench.plugins.estimators.reinforce",
)  # fmt: skip


@contextmanager
def followed():
    """Follow the state of the process, with the libraries imported that the changes need."""
    for name in LIBRARIES:
        importlib.import_module(name)
    state = State(double_precision=True)
    try:
        yield state
    finally:
        state.restore()
        state.close()


ONCE = ("fft_workers",)
"""Changes that cannot be undone in this process."""


SLOW = ("deterministic",)
"""Changes that import much."""
KINDS = [pytest.param(kind, marks=[pytest.mark.slow] * (kind in SLOW)) for kind in CHANGES if kind not in ONCE]


@pytest.mark.parametrize("kind", KINDS)
def test_a_change_of_the_process_is_named_and_undone(kind):
    code, words = CHANGES[kind]
    if kind == "cores" and len(os.sched_getaffinity(0)) == 1:
        pytest.skip("there is one core")
    with followed() as state:
        assert state.changes() == []
        exec(code, {"np": np, "os": os})
        changes = state.changes()
        state.restore()
        assert words in "; ".join(changes)
        assert len(changes) <= 2
        assert state.changes() == []


def test_decimal_arithmetic_before_and_after_is_no_change_and_settings_come_back():
    """Arithmetic sets flags of the context: with them in the comparison, settings that were restored still looked changed."""
    with decimal.localcontext() as own:
        own.prec, own.flags[decimal.Inexact] = 31, True
        with followed() as state:
            decimal.Decimal(2).sqrt()
            assert state.changes() == []
            decimal.getcontext().prec = 5
            assert "the decimal context" in "; ".join(state.changes())
            state.restore()
            assert state.changes() == []
            assert decimal.getcontext().prec == 31


# ------------------------------------------------------------------------------------------------------------- runs

WORDS = ["scenes=[quadratic]", "samples=8", "repeats=4", "timing=false", "reference.samples=4096", "name=changed"]


def rows_of_run(folder, backend, kinds, workers):
    """Return the rows of a run of ``fobg``, changing estimators and ``reinforce``, by estimator."""
    (folder / "mine").mkdir()
    for kind in kinds:
        (folder / "mine" / f"{kind}.py").write_text(plugin(kind))
    names = ",".join(["fobg", *(f"changes_{kind}" for kind in kinds), "reinforce"])
    words = [*WORDS, f"workers={workers}", f"backends=[{backend}]", f"estimators=[{names}]", f"results_dir={folder}"]
    execute(load([*words, f"plugins=[{folder / 'mine'}]"]))
    return pd.read_parquet(folder / "changed" / "rows.parquet").set_index("estimator")


def check_rows(rows, kinds, clean):
    """Assert that changes are named, and that they change no number of the cells after them."""
    for name in ("fobg", "reinforce"):
        assert rows["mean_estimate"][name].tobytes() == clean["mean_estimate"][name].tobytes()
        assert rows["reason"][name] == clean["reason"][name]
    for kind in kinds:
        row = rows.loc[f"changes_{kind}"]
        assert "a plugin of this cell changed" in row["reason"], kind
        assert CHANGES[kind][1] in row["reason"]
        assert row["status"] in ("ok", "error")
        if row["status"] == "ok" and kind not in OWN_SUMS:  # its gradients precede its change
            assert row["mean_estimate"].tobytes() == clean["mean_estimate"]["fobg"].tobytes()


OWN_SUMS = ("rounding",)
"""Changes that reach the means and norms of the cell itself, which follow its gradients."""
QUICK = ["norm", "seterr", "environment", "json", "own_method", "np_draw", "sqrt", "builtin"]


def test_a_change_reaches_no_other_cell_of_a_run_in_this_process(tmp_path):
    for name in ("clean", "dirty"):
        (tmp_path / name).mkdir()
    clean = rows_of_run(tmp_path / "clean", "numpy", [], 0)
    check_rows(rows_of_run(tmp_path / "dirty", "numpy", QUICK, 0), QUICK, clean)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["numpy", "jax"])
def test_a_change_of_any_kind_reaches_no_other_cell_of_a_worker(tmp_path, backend):
    kinds = [kind for kind in CHANGES if kind != "cores" or len(os.sched_getaffinity(0)) > 1]
    for name in ("clean", "dirty"):
        (tmp_path / name).mkdir()
    clean = rows_of_run(tmp_path / "clean", backend, [], 1)
    rows = rows_of_run(tmp_path / "dirty", backend, kinds, 1)
    # a worker that has run code from outside runs nothing else, so a setting of a library that is not in use may go unnamed
    check_rows(rows, [kind for kind in kinds if kind != "x64" or backend == "jax"], clean)
    assert rows["dtype"].eq("float32").sum() == (backend == "jax")


IMPORTED = "import numpy as np\nnp.seterr(all='raise')\nnp.linalg.norm = None\n"


def test_a_change_by_an_import_is_undone_and_named(tmp_path, capfd):
    (tmp_path / "imported.py").write_text(IMPORTED)
    before, norm = np.geterr(), np.linalg.norm
    registry.add_folder(tmp_path)
    registry.entries()
    assert np.geterr() == before
    assert np.linalg.norm is norm
    assert "imported, while it was imported, changed NumPy's error state" in capfd.readouterr().err


FRESH = """
import sys
from bench.model.isolation import State
state = State(double_precision=True)
import jax
assert jax.config.jax_enable_x64
assert state.changes() == [], state.changes()
jax.config.update("jax_enable_x64", False)
import scipy.stats  # an import after the change may not undo it unnamed
assert state.changes() == ["JAX's configuration (jax_enable_x64)"]
state.restore()
assert jax.config.jax_enable_x64
"""


def test_the_settings_of_a_library_are_followed_from_its_import_on():
    subprocess.run([sys.executable, "-c", FRESH], check=True)


def test_an_import_of_an_installed_library_is_no_change(tmp_path, monkeypatch):
    library = tmp_path / "site-packages" / "sets_things.py"
    library.parent.mkdir()
    library.write_text("import os\nos.environ['SETS_THINGS'] = '1'\n")
    (tmp_path / "own_things.py").write_text("import os\nos.environ['OWN_THINGS'] = '1'\n")
    monkeypatch.setenv("SETS_THINGS", "0")
    monkeypatch.setenv("OWN_THINGS", "0")
    for folder in (library.parent, tmp_path):
        monkeypatch.syspath_prepend(folder)
    with followed() as state:
        np.seterr(over="raise")
        importlib.import_module("sets_things")
        assert state.changes() == ["NumPy's error state (over)"]  # what a plugin changed before the import is known
        importlib.import_module("own_things")
        assert "environment variables (OWN_THINGS)" in state.changes()


@pytest.mark.parametrize(
    "block",
    [lambda: np.errstate(over="ignore", invalid="ignore"), lambda: jax.enable_x64(not jax.config.jax_enable_x64)],
    ids=["numpy", "jax"],
)
def test_an_import_within_a_block_that_changes_a_setting_is_no_change(tmp_path, monkeypatch, block):
    """The setting is as before when the block ends."""
    monkeypatch.delitem(sys.modules, "set_inside", raising=False)
    library = tmp_path / "site-packages" / "set_inside.py"
    library.parent.mkdir()
    library.write_text("INSIDE = 1\n")
    monkeypatch.syspath_prepend(library.parent)
    with followed() as state:
        with block():
            importlib.import_module("set_inside")
        assert state.changes() == []
        np.seterr(under="raise")
        assert state.changes() == ["NumPy's error state (under)"]


def test_cells_in_this_process_use_one_thread_and_its_own_number_comes_back():
    def counts():
        return [library.num_threads for library in ThreadpoolController().lib_controllers]

    with threadpool_limits(2):
        before = counts()
        state = State(single_thread=True)
        assert set(counts()) == {1}
        assert state.changes() == []
        state.close()
        assert counts() == before


def test_a_run_in_this_process_has_one_thread_in_its_cells(tmp_path, monkeypatch):
    seen = []
    read = tasks.measure_cell

    def measure(*given):
        seen.append({library.num_threads for library in ThreadpoolController().lib_controllers})
        return read(*given)

    monkeypatch.setattr(tasks, "measure_cell", measure)
    with threadpool_limits(2):
        rows_of_run(tmp_path, "numpy", [], 0)
    assert seen == [{1}] * 2
