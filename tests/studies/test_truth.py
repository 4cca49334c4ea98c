"""One truth: each bias, error and cosine of estimates stands on the certified reference, in every study."""

import math
import re

import pytest
from helpers import loaded

import bench.plugins  # noqa: F401
from bench.experiment.study import study_of
from bench.model import registry
from bench.run.session import Session

STUDIES = {name: entry.plugin for name, entry in registry.entries()["studies"].items() if entry.plugin is not None}
JUDGED = ("bias", "bias_rel", "rmse", "rmse_rel", "cosine", "zeroth_rmse_rel", "quality_bias_share", "quality_rmse_rel",
          "quality_cosine")  # fmt: skip
"""Columns that judge estimates of grad J_sigma, and so stand on its certified reference."""
OF_OTHERS = {
    "three_errors": {"forward_error", "program_error", "model_error", "model_cosine"},
    "engines": {"program_error", "model_error"},
    "bias_variance": {"model_error", "rmse_start"},
    "solver": {"gradient_error", "gradient_cosine"},
    "stability": {"relative_error", "cosine", "truth_error", "step_error", "law_error"},
    "twins": {"gradient_error", "gradient_cosine", "path_error", "cost_error"},
    "backward_memory": {"gradient_error"},
    "gradient_check": {"best_error", "check_error", "relative_error"},
    "identify": {"bias", "biased", "error", "errors"},
    "train": {"cosine", "cosine_update", "cosine_denoised", "slope_errors", "window_bias"},
}
"""Columns of single gradients or of fits, by study: against the program, its physics, or another method, as their descriptions say."""
SCENE = ["scenes=[soft_heaviside]", "scene.soft_heaviside.nu=1e-8", "backends=[numpy]"]
SAMPLES, REPEATS = 64, 200


def columns_of(study, pattern=r"(^|_)(bias|rmse|cosine|error)"):
    stems = {name.removesuffix("_low").removesuffix("_high") for name in study.columns.by_name}
    return {name for name in stems if re.search(pattern, name)}


def judged(name, study):
    return sorted((set(JUDGED) & columns_of(study)) - OF_OTHERS.get(name, set()))


@pytest.mark.parametrize("estimator", ["fobg", "reinforce"])
@pytest.mark.parametrize("name", [name for name, study in STUDIES.items() if judged(name, study)])
def test_errors_are_those_against_the_closed_form(tmp_path, name, estimator):
    """Of a ramp that no sample meets, first-order estimates are 0, and zeroth-order ones right with the variance of a jump's."""
    study = STUDIES[name]
    own = [f"estimators=[{estimator}]"] if "estimator" in study.axes else []
    words = ["name=one", f"study={name}", *SCENE, *own, f"samples={SAMPLES}", f"repeats={REPEATS}", "workers=0"]
    given, (cell,) = loaded(*words, f"results_dir={tmp_path}")
    row = study_of(given).measure(cell, Session(given))
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
