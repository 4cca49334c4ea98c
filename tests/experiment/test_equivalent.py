"""Files whose changes decide no stored number: the stored rows still come out."""

import ast
import json

import numpy as np
import pandas as pd
import pytest
from trees import ROOT

import bench
from bench.experiment import config
from bench.experiment.axes import build_plugins
from bench.experiment.by_name import compile_problem
from bench.experiment.grid import cells
from bench.experiment.keys import study_tree
from bench.measure import noise
from bench.model.sources import EQUIVALENT, code_hash, hash_of_tree

SAME = 1e-7
"""Relative difference allowed: tests compile with other flags, and the double pendulum multiplies rounding by 1e7."""
FILES = [path for folder in ("bench", "plugins") for path in sorted((ROOT / folder).rglob("*.py"))]


def test_every_entry_is_in_use_and_leads_to_one_earlier_version():
    own = {path: hash_of_tree(ast.parse(path.read_bytes())) for path in FILES}
    studies = {
        hash_of_tree(study_tree(f"bench.studies.{path.parent.name}"))
        for path in FILES
        if path.match("studies/*/__init__.py")
    }
    present = set(own.values()) | studies
    assert set(EQUIVALENT) <= present, "an entry whose file has changed since belongs to no file"
    assert not set(EQUIVALENT.values()) & set(EQUIVALENT), "an earlier version is itself listed as a later one"
    changed = [path for path in FILES if own[path] in EQUIVALENT]
    assert [code_hash(path) for path in changed] == [EQUIVALENT[own[path]] for path in changed]


@pytest.mark.parametrize(
    ("name", "backend"),
    [
        ("quick", "jax"),
        pytest.param("estimators", "jax", marks=pytest.mark.slow),  # 25 estimators on 5 problems, each compiled
        ("windows", "jax"),
        ("stiffness_sweep", "jax"),
        ("engines", "mujoco"),
    ],
)
def test_stored_estimates_come_out_again(name, backend):
    experiment = config.load([f"experiment={name}", f"results_dir={ROOT / 'results/standard'}"])
    rows = bench.load(experiment.directory)
    rows = rows[(rows.status == "ok") & rows.backend.str.startswith(backend)]
    for _, row in rows.groupby(["scene", "estimator"]).head(1).iterrows():
        parts = build_plugins(json.loads(row["parameters"]))
        problem = compile_problem(parts["scene"], parts["contact"], parts["integrator"], row["backend"])
        drawn = noise.shared(
            int(row["seed"]), parts["scene"].name, int(row["repeats"]), int(row["samples"]), problem.program.n_noise
        )
        mean = parts["estimator"].estimate(problem, problem.program.theta0, drawn).mean(axis=0)
        stored = np.asarray(row["mean_estimate"])
        assert np.abs(mean - stored).max() <= SAME * np.abs(stored).max(), row["estimator"]


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted((ROOT / "conf/experiment").rglob("*.yaml")), ids=lambda path: path.stem)
def test_stored_rows_are_those_of_the_cells_of_their_experiment(path):
    """Documents count the rows of a folder, so a row from an earlier version of the experiment would count too."""
    experiment = config.load([f"+experiment={path.relative_to(ROOT / 'conf/experiment').with_suffix('')}"])
    stored = ROOT / "results/standard" / experiment.name / "rows.parquet"
    if stored.exists():
        keys = pd.read_parquet(stored, columns=["key"])["key"]
        assert not keys.duplicated().any()
        assert set(keys) <= {cell.key for cell in cells(experiment)}
