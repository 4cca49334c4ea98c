"""The study of backward passes: peaks in processes of their own, and their growth along the horizon."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers import unmeasured

import bench
from bench.experiment import config
from bench.experiment.grid import cells

CLOSE = 0.03
"""Relative error of a peak: the interpreter allocates beside the planted array."""
PLANTED_MB = 64
PLUGIN = f'''
"""NumPy with a planted array in each gradient, which the process keeps."""

from dataclasses import dataclass

import numpy as np

from bench.plugins.backends.numpy import Numpy, NumpyProblem

KEPT = []


@dataclass(frozen=True)
class Greedy(Numpy):
    """Gradients: those of numpy."""

    name = "greedy"
    reference_rank = None

    def compile(self, program):
        """Return the problem."""
        return GreedyProblem(program, self.dtype, 1e-6)


class GreedyProblem(NumpyProblem):
    """Fills an array."""

    def _grad(self, theta, w):
        KEPT.append(np.ones({PLANTED_MB} << 17))
        return super()._grad(theta, w)
'''


def test_a_planted_array_is_the_peak_of_each_call_in_a_process_per_cell(tmp_path):
    (tmp_path / "backends").mkdir()
    (tmp_path / "backends" / "greedy.py").write_text(PLUGIN)
    rows = bench.run(
        study="backward_memory",
        scenes=["mass_spring"],
        backends=["greedy"],
        sweep={"horizon": [2, 3]},
        samples=4,
        plugins=tmp_path,
        results_dir=tmp_path,
    )
    for end in ("", "_low", "_high"):
        assert list(rows[f"memory_mb{end}"]) == pytest.approx([PLANTED_MB] * 2, rel=CLOSE)
    assert rows["process_mb"].min() > 20, "an interpreter with NumPy"
    assert rows["process_mb"].iloc[1] == pytest.approx(rows["process_mb"].iloc[0], abs=PLANTED_MB), (
        "not what others kept"
    )


# ----------------------------------------------------------------------------------------------------- views


SECONDS = {"jax": 1.0, "torch": 2.0, "fused": 1.5}


def rows():
    """An experiment, and rows of three backends at three horizons: memory T, T / 10, and the root of T."""
    words = ("scenes=[mass_spring]", "backends=[jax,torch,fused]", "sweep.horizon=[100,1000,10000]")
    given, rows = unmeasured("study=backward_memory", *words, compared_with="jax", gradient_error_rel=1e-13)
    steps, name = rows["horizon"], rows["backend"]
    memory = np.select([name == "jax", name == "torch"], [steps, steps / 10], np.sqrt(steps))
    for column, values, reach in (("memory_mb", memory, 0.01), ("gradient_s", name.map(SECONDS), 0.1)):
        ends = {f"{column}_low": values * (1 - reach), f"{column}_high": values * (1 + reach)}
        rows = rows.assign(**{column: values}, **ends)
    return given, rows


def test_orders_and_ratios_at_the_longest_horizon_are_those_of_the_memory():
    given, table = rows()
    table = given.study.show(given, table).tables[0].frame
    assert list(table["method"]) == ["jax", "torch", "fused"]
    assert list(table["order"]) == pytest.approx([1.0, 1.0, 0.5])
    assert list(table["less"]) == pytest.approx([math.nan, 10.0, 100.0], nan_ok=True), "jax is not compared with itself"
    assert (table["order_low"] < table["order"]).all()
    assert (table["order"] < table["order_high"]).all()
    assert list(table["longer"]) == pytest.approx([math.nan, 2.0, 1.5], nan_ok=True)


def test_without_a_result_of_the_first_method_no_other_takes_its_place():
    given, table = rows()
    table.loc[table["backend"] == "jax", "status"] = "error"
    assert given.study.show(given, table).tables[0].frame["less"].isna().all()


def test_backends_without_gradients_are_refused():
    given = config.load(["study=backward_memory", "scenes=[mass_spring]", "backends=[numpy]"])
    (cell,) = cells(given)
    blind = replace(cell.backend)
    object.__setattr__(blind, "provides", frozenset({"value"}))
    assert given.study.refusal(cell) is None
    assert "computes no gradients" in given.study.refusal(cell.with_part("backend", blind))
