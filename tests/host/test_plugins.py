"""Plugins are found by being there, and neither a broken nor an absent one disturbs the rest."""

import pandas as pd
import pytest
from trees import Tree

ESTIMATOR = '''
"""A plugin for a test."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.plugin import Problem, SampleMean, param


@dataclass(frozen=True)
class Dropped(SampleMean):
    """Approximates grad J_sigma with the first-order mean times a factor."""

    name = "{name}"
    requires: ClassVar[tuple[str, ...]] = ({requires})
    needs = frozenset({{"grad"}})

    factor: float = param(1.0, "what the mean is multiplied by")

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Gradients times the factor."""
        return self.factor * problem.grad(theta, w)
'''


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    made = Tree(tmp_path_factory.mktemp("plugins"))
    made.add("plugins/estimators/half_step.py", ESTIMATOR.format(name="half_step", requires=""))
    absent = ESTIMATOR.format(name="absent", requires='"no_such_module=some-dist",')
    made.add("plugins/estimators/absent.py", absent)
    made.add("plugins/.half_step.py", "an editor's copy")
    made.install(
        "third_party",
        ESTIMATOR.format(name="third_name", requires=""),
        "[bench.plugins]\nthird_name = third_party:Dropped\ngone = third_party:NotThere\n",
    )
    return made


@pytest.fixture(scope="module")
def listing(tree):
    done = tree.run("list", "estimators", "scenes", "backends", "studies")
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def rows(tree):
    """A run of a dropped, a third-party and an unavailable plugin beside a built-in one."""
    done = tree.run(
        "scenes=[quadratic]",
        "backends=[numpy]",
        "estimators=[fobg,half_step,third_name,absent]",
        "estimator.half_step.factor=0.5",
        "samples=8",
        "repeats=4",
        "name=mine",
        "workers=0",
        "results_dir=out",
        "timing=false",
        "formats=[]",
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return pd.read_parquet(tree.root / "out" / "mine" / "rows.parquet").set_index("estimator")


def entry_of(listing, name):
    """The lines about one plugin in the output of ``list``."""
    lines = listing.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"  {name} "))
    length = next((n for n, line in enumerate(lines[start + 1 :]) if not line.startswith("   ")), len(lines))
    return "\n".join(lines[start : start + 1 + length])


@pytest.mark.parametrize("name", ["half_step", "third_name"])
def test_added_plugin_is_listed_with_its_parameters(listing, name):
    described = entry_of(listing, name)
    assert "first-order mean times a factor" in described
    assert "needs grad" in described
    assert "factor=1" in described
    assert "UNAVAILABLE" not in described


@pytest.mark.slow
def test_added_plugins_run_and_take_parameters_from_the_command_line(rows):
    assert rows.loc[["fobg", "half_step", "third_name"], "status"].tolist() == ["ok"] * 3
    assert rows.loc["half_step", "estimator_params"] == "factor=0.5"
    assert rows.loc["half_step", "grad_norm"] == pytest.approx(rows.loc["fobg", "grad_norm"] / 2)
    assert rows.loc["third_name", "grad_norm"] == rows.loc["fobg", "grad_norm"]


def test_a_hidden_file_is_no_plugin(listing):
    assert ".half_step" not in listing


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("gone", "NotThere"),
        ("absent", "pip install some-dist"),
    ],
)
def test_unusable_plugin_is_listed_with_its_reason(listing, name, reason):
    described = entry_of(listing, name)
    assert "UNAVAILABLE" in described
    assert reason in described


@pytest.mark.slow
def test_cells_of_an_unavailable_plugin_become_rows(rows):
    assert rows.loc["absent", "status"] == "unavailable"
    assert "pip install some-dist" in rows.loc["absent", "reason"]
