"""Who wins where: intervals that combine bias and variance, ties, and failures."""

import numpy as np
import pandas as pd

from bench.studies.bias_variance.ranking import best, rank_estimators


def cell(estimator, scene, bias, variance, **more):
    """A row whose bias and variance are known to 20%, against a gradient of norm 2."""
    row = {
        "estimator": estimator, "estimator_params": "", "scene": scene, "contact": "none", "status": "ok", "reference_norm": 2.0,
        "bias": bias, "variance": variance, "bias_low": 0.8 * bias, "bias_high": 1.2 * bias, "variance_low": 0.8 * variance, "variance_high": 1.2 * variance,
        "rmse": float(np.hypot(bias, variance**0.5)), "samples": 8, "rollouts": 8.0, "gradients": 0.0,
    }  # fmt: skip
    return row | {"rmse_rel": row["rmse"] / 2.0} | more


def test_winners_failures_and_bias():
    rows = [
        cell(e, s, b, v) for s in ("one", "two") for e, b, v in (("good", 0, 0.04), ("near", 0, 0.05), ("off", 3, 0.1))
    ]
    rows += [cell("missing", "one", 0, 1, status="unsupported"), cell("loud", "two", 0, 9.0, rollouts=320.0)]
    table = rank_estimators(pd.DataFrame(rows)).set_index(["label", "problem"])
    assert table.loc[("good", "one"), "verdict"] == "wins"
    assert table.loc[("near", "one"), "verdict"] == "wins"
    assert table.loc[("off", "one"), "verdict"] == "fails, biased"
    assert table.loc[("loud", "two"), "verdict"] == "fails"
    assert table.loc[("loud", "two"), "text"].endswith("fails (40x)")
    assert table.loc[("missing", "one"), "text"] == "unsupported"
    assert np.isclose(table.loc[("good", "one"), "high"], (1.2 * 0.04) ** 0.5 / 2)


def test_swept_rows_and_single_problems_have_no_such_table():
    rows = [cell(e, "one", 0, 1) for e in "abc"]
    assert rank_estimators(pd.DataFrame(rows)).empty
    assert rank_estimators(pd.DataFrame([*rows, *rows])).empty


def test_the_best_setting_is_chosen_at_equal_work():
    """Four evaluations per sample leave a quarter of the samples: twice the standard deviation."""
    rows = [
        cell(name, scene, bias, variance, estimator_params=setting, rollouts=8.0 * work)
        for scene in ("one", "two")
        for name, setting, bias, variance, work in (
            ("plain", "", 0.0, 0.09, 1), ("costly", "", 0.0, 0.04, 4), ("set", "a=1", 0.0, 0.25, 1), ("set", "a=2", 0.0, 0.08, 1),
        )
    ]  # fmt: skip
    table = best(rank_estimators(pd.DataFrame(rows))).set_index(["estimator", "problem"])
    assert table.loc[("set", "one"), "label"] == "set[a=2]"
    assert np.isclose(table.loc[("costly", "one"), "equal"], (4 * 0.04) ** 0.5 / 2)
    assert table.loc[("plain", "two"), "verdict"] == "wins"
    assert table.loc[("costly", "two"), "verdict"] == ""
