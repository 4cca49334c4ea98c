"""What an estimator reports of itself is stored with the row and said in a sentence."""

import json

import numpy as np
import pandas as pd

import bench
from bench.studies.bias_variance.reported import loose_references, sentences


def test_a_weight_that_is_switched_off_is_stored_and_said(tmp_path):
    rows = bench.run(
        scenes=["heaviside"], backends=["numpy"], estimators=["fobg", "alpha_order[gamma=0.01]", "inverse_variance"],
        samples=16, repeats=8, timing=False, workers=0, results_dir=tmp_path,
    )  # fmt: skip
    stored = dict(zip(rows["estimator"], rows["auxiliaries"], strict=True))
    assert stored["fobg"] == ""
    assert json.loads(stored["alpha_order"])["alpha"]["zero"] == 1.0
    said = sentences(rows)
    assert any(s.startswith("alpha_order[gamma=0.01]: alpha is 0 to 0") and "does nothing there" in s for s in said)
    assert any(s.startswith("inverse_variance: weight is") for s in said)


def test_references_outside_their_tolerance_are_counted_with_the_largest_error():
    rows = pd.DataFrame({
        "status": ["ok", "ok", "ok", "unsupported", "ok", "ok"], "scene": ["a", "b", "c", "d", "e", "f"],
        "reference_norm": [2.0, 1.0, 10.0, 1.0, 0.0, np.nan], "reference_se": [0.01, 0.034, 0.11, 1.0, 1.0, np.nan],
    })  # fmt: skip
    (text,) = loose_references(rows, 0.01)
    assert text.startswith(
        "the standard error of the reference is above its tolerance of 1% in 2 cells, up to 3.4% (b)"
    )
    assert loose_references(rows, 0.05) == []
