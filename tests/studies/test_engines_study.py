"""The study of engines: an engine's errors, statistics and shares of time, and which gradient can be used."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from bench.plugins.studies.engines import LEVELS, levels

import bench
from bench.cli import main
from bench.engines.process import close_engines

TOYS = Path(__file__).resolve().parents[1] / "engines" / "toys"


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    words = [
        "name=own",
        "study=engines",
        f"plugins={TOYS}",
        "scenes=[bouncing_ball]",
        "contacts=[penalty]",
        f"backends=[numpy,'toy[python={sys.executable}]']",
        "scene.bouncing_ball.horizon=40",
        "samples=4",
        "repeats=4",
        "reference.samples=256",
        "reference.tolerance=1",
        "workers=0",
        "--quiet",
        f"results_dir={folder}",
    ]
    assert main(words) == 0
    close_engines()
    return folder / "own"


@pytest.mark.slow
def test_an_engine_has_the_errors_of_the_same_program_in_this_process(results):
    rows = bench.load(results)
    assert list(rows["status"]) == ["ok", "ok"]
    ours, theirs = (row for _, row in rows.iterrows())
    assert theirs["program_error_rel"] < 1e-6
    np.testing.assert_allclose(theirs["model_error_rel"], ours["model_error_rel"], rtol=1e-6)
    np.testing.assert_allclose(theirs["variance"], ours["variance"], rtol=1e-6)
    np.testing.assert_allclose(theirs["zeroth_rmse_rel"], ours["zeroth_rmse_rel"], rtol=1e-6)
    assert theirs["model"] == "rigid contact"
    assert list(rows["nan_share"]) == [0.0, 0.0]


def test_shares_of_the_time_are_of_engines_in_another_python_only(results):
    ours, theirs = (row for _, row in bench.load(results).iterrows())
    assert np.isnan(ours["pipe_share"])
    assert 0 < theirs["pipe_share"] < 1
    assert 0 < theirs["pass_share"] < 1
    assert theirs["pipe_share"] + theirs["pass_share"] < 1
    assert 10 < theirs["memory_mb"] < ours["memory_mb"]
    assert ours["device"] == theirs["device"] == "cpu"
    assert "processors=" in theirs["engine_settings"]


@pytest.mark.parametrize(
    ("expected", "changes"),
    [
        ("right", {}),
        ("own", {"model_error_rel": 0.5}),
        ("noisy", {"variance": 4.0}),
        ("noisy", {"bias_low": 1.5, "bias_high": 2.0}),
        ("open", {"variance": 1.2}),
        ("open", {"variance": 0.36}),
        ("open", {"bias_high": 1.1}),
        ("open", {"reference_se": 0.6}),
        ("open", {"rmse_rel": 0.0, "bias_high": 0.7, "reference_se": 0.3}),
        ("noisy", {"variance": 400.0, "reference_se": 3.0}),
        ("wrong", {"program_error_rel": 0.5}),
        ("wrong", {"program_error_rel": np.nan}),
        ("wrong", {"nan_share": 0.1}),
        ("wrong", {"status": "nonfinite"}),
        ("none", {"gradient": []}),
    ],
)
def test_levels_of_a_gradient(expected, changes):
    good = {
        "status": "ok",
        "gradient": [1.0],
        "program_error_rel": 1e-6,
        "model_error_rel": 0.01,
        "rmse_rel": 0.2,
        "bias_low": 0.0,
        "bias_high": 0.05,
        "variance": 0.04,
        "nan_share": 0.0,
        "repeats": 8,
        "reference_se": 0.02,
        "reference_norm": 1.0,
    }
    assert levels(pd.DataFrame([good | changes])) == [expected]
    assert expected in LEVELS
