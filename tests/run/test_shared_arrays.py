"""A plugin that writes in place into the arrays it gets changes no number of another cell."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from bench.experiment.config import load
from bench.experiment.grid import cells
from bench.measure import noise
from bench.run.execute import execute
from bench.run.session import RunSession

WAYS = {
    "numpy": "base = array if array.base is None else array.base\n    base.setflags(write=True)\n    base *= 2.0",
    "torch": "import torch\n    torch.from_numpy(array).mul_(2.0)",
    "jax": "import jax.numpy as jnp, torch\n    torch.from_dlpack(jnp.asarray(array)).mul_(2.0)",
}
"""Ways to write into an array that may be read-only."""
ARRAYS = {"noise": "noise", "theta": "problem.program.theta0", "problem": "problem._parameters"}
"""Arrays that an estimator can reach."""
PLUGIN = '''
"""Writes into what it gets."""

from bench.plugin import SampleMean


def double(array):
    {way}


class {name}(SampleMean):
    """The mean of gradients, but it doubles an array first.

    Approximates grad J. With the mean of gradients. Requires gradients.
    """

    name = "{name}"
    needs = frozenset({{"grad"}})
    unbiased = True

    def estimate(self, problem, theta, noise):
        double({array})
        return super().estimate(problem, theta, noise)

    def terms(self, problem, theta, noise):
        return problem.grad(theta, noise)
'''
WORDS = [
    "scenes=[quadratic]",
    "backends=[jax]",
    "samples=8",
    "repeats=4",
    "timing=false",
    "reference.samples=4096",
    "name=shared",
]


def rows(folder, names, workers):
    """Return the rows of ``fobg`` and ``reinforce`` measured after the estimators ``names``."""
    (folder / "mine").mkdir(parents=True, exist_ok=True)
    chosen = ",".join([*names, "fobg", "reinforce"])
    words = [*WORDS, f"estimators=[{chosen}]", f"results_dir={folder}/results", f"workers={workers}"]
    finished = execute(load([*words, f"plugins={folder}/mine"]))
    table = finished.store.load().set_index("estimator")
    return table.loc[["fobg", "reinforce"]], table.loc[names]


@pytest.mark.filterwarnings("ignore:The given NumPy array is not writable")
@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_writing_in_place_changes_no_other_cell(tmp_path, workers):
    plain, _ = rows(tmp_path / "plain", [], workers)
    (tmp_path / "hostile" / "mine").mkdir(parents=True)
    names = []
    for way, code in WAYS.items():
        for kind, array in ARRAYS.items():
            names.append(f"writes_{way}_{kind}")
            source = PLUGIN.format(name=names[-1], way=code, array=array)
            (tmp_path / "hostile" / "mine" / f"{names[-1]}.py").write_text(source)
    after, own = rows(tmp_path / "hostile", names, workers)
    numbers = plain.select_dtypes("number").columns.drop(["wall_s", "stored_at", "sequence"])
    pd.testing.assert_frame_equal(plain[numbers], after[numbers], check_exact=True)
    assert (own["status"] == "ok").all(), own["reason"].tolist()


def test_every_caller_has_arrays_of_its_own(tmp_path):
    experiment = load([*WORDS, "estimators=[fobg]", f"results_dir={tmp_path}"])
    cell, session = cells(experiment)[0], RunSession(experiment)
    reference, problem = session.references.of(cell), session.problem(cell)
    kept = [np.array(value) for value in vars(reference).values() if isinstance(value, np.ndarray)]
    for value in vars(reference).values():
        if isinstance(value, np.ndarray):
            value *= 2.0
    again = dataclasses.asdict(session.references.of(cell))
    for before, after in zip(kept, (v for v in again.values() if isinstance(v, np.ndarray)), strict=True):
        np.testing.assert_array_equal(before, after)
    for read in (lambda: problem.program.theta0, lambda: problem.program.noise_free):
        assert not np.shares_memory(read(), read())
    drawn = [noise.shared(0, "quadratic", 2, 3, 4) for _ in range(2)]
    assert not np.shares_memory(*drawn)
    assert np.array_equal(*drawn)
    assert drawn[0].strides == noise.draw(0, "quadratic", 2, 3, 4, "cells").strides


def test_noise_is_kept_within_limits(monkeypatch):
    for limit, value in (("HELD", 10), ("KEPT", 16), ("_kept", {})):
        monkeypatch.setattr(noise, limit, value)
    for name, samples in (("a", 2), ("b", 6), ("c", 2), ("a", 2), ("d", 2)):
        noise.shared(0, name, 1, samples, 4)
    assert [name for _, name, *_ in noise._kept] == ["a", "d"]
