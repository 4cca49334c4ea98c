"""What an estimator reports of itself is stored with the row and said in a sentence."""

import json

import bench
from bench.studies.bias_variance.reported import sentences


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
