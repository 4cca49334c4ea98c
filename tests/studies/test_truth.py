"""One truth: each bias, error and cosine of estimates stands on the certified reference, in every study."""

import math

import pytest
from helpers import loaded

import bench.plugins  # noqa: F401
from bench.model import registry
from bench.run.session import RunSession

STUDIES = {name: entry.plugin for name, entry in registry.entries()["studies"].items() if entry.plugin is not None}
JUDGED = (
    "bias",
    "bias_rel",
    "rmse",
    "rmse_rel",
    "cosine",
    "zeroth_rmse_rel",
    "quality_bias_share",
    "quality_rmse_rel",
    "quality_cosine",
)
"""Columns that judge estimates of grad J_sigma, and so stand on its certified reference."""
OF_OTHERS = {"stability": {"cosine"}, "identify": {"bias"}, "train": {"cosine"}}
"""Columns of these names that judge something else, by study: a single gradient, a fit, or gradients of both orders."""
SCENE = ["scenes=[soft_heaviside]", "scene.soft_heaviside.nu=1e-8", "backends=[numpy]"]
SAMPLES, REPEATS = 64, 200


def judged(name, study):
    return sorted(set(JUDGED) & set(study.columns.by_name) - OF_OTHERS.get(name, set()))


@pytest.mark.parametrize("estimator", ["fobg", "reinforce"])
@pytest.mark.parametrize("name", [name for name, study in STUDIES.items() if judged(name, study)])
def test_errors_are_those_against_the_closed_form(tmp_path, name, estimator):
    """Of a ramp that no sample meets, first-order estimates are 0, and zeroth-order ones right with the variance of a jump's."""
    study = STUDIES[name]
    own = [f"estimators=[{estimator}]"] if "estimator" in study.axes else []
    words = ["name=one", f"study={name}", *SCENE, *own, f"samples={SAMPLES}", f"repeats={REPEATS}", "workers=0"]
    given, (cell,) = loaded(*words, f"results_dir={tmp_path}")
    row = given.study.measure(cell, RunSession(given))
    exact = float(cell.scene.closed_form_gradient(None, None)[0])
    # a cost of -1 or 1 times a score of w / sigma, with grad J = sqrt(2 / pi) / sigma; a baseline of the others' mean costs
    noise = math.sqrt((math.pi / 2 - 1) / SAMPLES) * math.sqrt(SAMPLES / (SAMPLES - 1))
    zeroth = {"bias": 0, "bias_rel": 0, "rmse": exact * noise, "rmse_rel": noise, "cosine": 1, "bias_share": 0}
    first = {"bias": exact, "bias_rel": 1, "rmse": exact, "rmse_rel": 1, "cosine": 0, "bias_share": 1}
    assert row["reference_method"] == "closed_form"
    for column in judged(name, study):
        is_first = "zeroth" not in column and (estimator == "fobg" or not own)
        stem = column.removeprefix("quality_").removeprefix("zeroth_")
        # five standard errors of a root mean square of REPEATS estimates; a bias is known to the error of their mean
        near = pytest.approx((first if is_first else zeroth)[stem], rel=5 / math.sqrt(2 * REPEATS), abs=5 / REPEATS)
        assert row[column] == near, column
