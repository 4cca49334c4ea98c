"""Findings of the main study: computed a second way from the committed tables, and on planted rows."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from helpers import approve, experiment, failed, row, table

from bench.report.views import arrange
from bench.studies.bias_variance.charts import accurate_and_fast
from bench.studies.bias_variance.comparisons import (
    FAILS,
    NO_RESULT,
    OPEN,
    WORKS,
    compare_errors,
    method_table,
    ratio,
    verdict,
    verdicts_by_estimator,
)
from bench.studies.bias_variance.findings import findings

STANDARD = Path(__file__).resolve().parents[2] / "results" / "standard"


def cell(error, low, high, **values):
    """A row whose relative RMSE has exactly this interval, with bias 0."""
    norm = 4.0
    made = row(**values)
    return made | {
        "bias": 0.0, "bias_low": 0.0, "bias_high": 0.0, "rmse_rel": error, "rmse": norm * error, "variance": (norm * error) ** 2,
        "variance_low": (norm * low) ** 2, "variance_high": (norm * high) ** 2,
    }  # fmt: skip


def made(*cells, **given):
    """Methods, comparisons and findings of cells along the stiffness."""
    rows = table(list(cells))
    found = arrange(
        experiment(**({"sweep": {"stiffness": sorted(map(float, rows["stiffness"].unique()))}} | given)), rows
    )
    methods = method_table(found)
    compared = compare_errors(methods)
    return methods, compared, findings(methods, compared, {"limit": 6400.0})


# ------------------------------------------------------------------------------------ verdicts and comparisons


@pytest.mark.parametrize(
    ("status", "error", "low", "high", "expected"),
    [
        ("ok", 0.5, 0.4, 0.6, WORKS), ("ok", 1.3, 0.65, 2.4, OPEN), ("ok", 0.71, 0.42, 4.0, OPEN), ("ok", 2.0, 1.5, 3.0, FAILS),
        ("ok", math.nan, math.nan, math.nan, OPEN), ("ok", 0.5, math.nan, math.nan, OPEN), ("ok", 2.0, 1.5, math.inf, FAILS),
        ("ok", 0.5, 0.1, math.inf, OPEN), ("nonfinite", math.nan, math.nan, math.nan, NO_RESULT),
    ],
)  # fmt: skip
def test_a_verdict_needs_the_whole_interval(status, error, low, high, expected):
    assert verdict(status, error, low, high) == expected


def test_the_interval_of_a_factor_covers():
    """Two errors with lognormal noise: the interval of their ratio contains the truth in at least 95% of draws."""
    generator = np.random.default_rng(0)
    widths, hits = (0.2, 0.05), 0
    for _ in range(2000):
        a, b = (m * math.exp(w * z) for m, w, z in zip((1.0, 3.0), widths, generator.standard_normal(2), strict=True))
        ends = [(v, v * math.exp(-1.96 * w), v * math.exp(1.96 * w)) for v, w in zip((a, b), widths, strict=True)]
        _, low, high = ratio(*ends)
        hits += low <= 3.0 <= high
    assert 0.94 <= hits / 2000 <= 0.96


def test_methods_are_tied_unless_the_interval_of_their_factor_is_above_1():
    _, compared, texts = made(
        *(cell(e, 0.9 * e, 1.1 * e, stiffness=k, estimator=n) for k in (1e2, 1e4)
          for n, e in (("fobg", 0.10), ("reinforce", 0.105), ("finite_difference", 0.4)))
    )  # fmt: skip
    assert list(compared["first"]) == ["fobg", "fobg"]
    assert list(compared["tied"]) == [("reinforce",)] * 2
    assert (compared["factor_low"] < 1).all()
    assert "ties for the lowest error" in texts[0]


def test_a_missing_interval_cannot_be_first_and_an_unresolved_reference_is_open():
    methods, compared, texts = made(
        *(cell(0.05, math.nan, math.nan, stiffness=k, estimator="fobg") for k in (1e2, 1e4)),
        *(cell(0.3, 0.2, 0.4, stiffness=k, estimator="reinforce") for k in (1e2, 1e4)),
    )
    assert set(methods.loc[methods["estimator"] == "fobg", "verdict"]) == {OPEN}
    assert list(compared["first"]) == ["reinforce", "reinforce"]
    assert texts[0].startswith("Use reinforce everywhere")
    assert "1 is open" in texts[-1]


def test_nan_errors_are_never_a_pass():
    """An unresolved reference leaves no error: nothing may be said to be better than zero."""
    methods, compared, texts = made(
        *(row(stiffness=k) | {"rmse_rel": math.nan, "reference_norm": 0.0} for k in (1e2, 1e4)),
    )
    assert set(methods["verdict"]) == {OPEN}
    assert (compared["first"] == "").all()
    assert texts == ["No cell has an error that could be compared: the table has the reason of each."]


def test_a_failed_cell_fails_its_estimator_and_a_refused_one_does_not():
    methods, _, texts = made(
        *(cell(0.1, 0.09, 0.11, stiffness=k) for k in (1e2, 1e4)),
        cell(0.3, 0.2, 0.4, stiffness=1e2, estimator="reinforce"),
        failed("nonfinite", "1 of 32 estimates are not finite", stiffness=1e4, estimator="reinforce"),
        failed("unsupported", "it cannot", stiffness=1e2, estimator="finite_difference"),
    )
    counts = verdicts_by_estimator(methods)
    assert counts.loc["reinforce", NO_RESULT] == 1
    assert counts.loc["fobg", WORKS] == 2
    assert "finite_difference" not in counts.index
    assert "1 of 2 estimators fails at some setting, 1 works at every setting (fobg)" in texts[-1]


# ---------------------------------------------------------------------------------------------------- sentences


def stiff(contact, stiffness):
    return 90.0 if contact == "penalty" and stiffness > 6400 else 0.1


def along_stiffness():
    """A method that fails beyond the limit under one of two laws, and one that is usable everywhere."""
    return [
        cell(e := error(contact, k), 0.9 * e, 1.1 * e, stiffness=k, contact=contact, estimator=name)
        for name, error in (("fobg", stiff), ("randomized_smoothing", lambda *_: 0.5))
        for contact in ("penalty", "complementarity")
        for k in (10.0, 1e3, 1e4, 1e5)
    ]


def of_problems():
    """A method that fails on one of three problems, and one that is usable on all."""
    return [
        cell(e, 0.9 * e, 1.1 * e, estimator=name, scene=scene)
        for name, errors in (("fobg", (0.01, 0.01, 50.0)), ("reinforce", (0.3, 0.4, 0.5)))
        for scene, e in zip(("pendulum", "cartpole", "pushing"), errors, strict=True)
    ]


def by_samples(estimator, rollouts, gradients=0.0, scale=1.0):
    """Cells whose error is ``scale`` over the root of N, with some rollouts and gradients per sample."""
    return [
        cell(
            e := scale / math.sqrt(n), 0.99 * e, 1.01 * e, estimator=estimator, samples=n, rollouts=rollouts * n + 0.01,
            gradients=gradients * n,
        )
        for n in (64, 128)
    ]  # fmt: skip


def test_costs_of_several_rollouts_per_sample_are_compared_at_equal_rollouts():
    """At equal samples `b` has 1 / 1.2 of the error of `a`, at equal rollouts 1.18 times."""
    cells = [*by_samples("a", 1), *by_samples("b", 2, scale=1 / 1.2)]
    _, compared, texts = made(*cells, sweep={"samples": [64, 128]})
    assert compared[["axis", "at", "basis", "first", "second"]].values.tolist() == [
        ["rollouts", 128.0, "relative RMSE at equal rollouts", "a", "b"]
    ]
    assert compared["factor"].iloc[0] == pytest.approx(math.sqrt(2) / 1.2)
    assert texts[0].startswith("Use a on pushing, penalty: it has the lowest error (relative RMSE 0.088).")


CASES = {
    "a failure beyond the limit": (along_stiffness, {}),
    "problems without an axis": (of_problems, {"sweep": {}}),
    "an interval around 1": (lambda: [cell(1.3, 0.65, 2.4, stiffness=k) for k in (1e2, 1e4)], {}),
    "gradients at equal samples": (
        lambda: [*by_samples("a", 0, 1), *by_samples("b", 2, scale=3.0)], {"sweep": {"samples": [64, 128]}},
    ),
    "one rollout a sample": (
        lambda: [*by_samples("a", 1), *by_samples("b", 1, scale=3.0)], {"sweep": {"samples": [64, 128]}},
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_the_recommendation_comes_first_then_the_failure_then_what_removes_it(case):
    cells, given = CASES[case]
    approve("bias_variance", case, *made(*cells(), **given)[2])


@pytest.mark.parametrize("path", sorted(STANDARD.glob("*/findings.json")), ids=lambda path: path.parent.name)
def test_stored_findings_are_short_and_their_chart_exists(path):
    found = json.loads(path.read_text())
    assert set(found) == {"experiment", "question", "findings", "chart"}
    assert 1 <= len(found["findings"]) <= 3
    assert all(text.endswith(".") and ";" not in text for text in found["findings"])
    assert not found["chart"] or (path.parent / f"{found['chart']}.png").exists()


def test_a_tie_is_no_win_of_the_lowest_error():
    """The title of error against time counts ties for both, and times by their medians."""
    near = {"rmse_rel": 0.5, "bias": 0.5, "bias_low": 0.3, "bias_high": 0.7}
    methods, compared, _ = made(
        row(stiffness=1.0, estimator="one", time_s=2.0, **near), row(stiffness=1.0, estimator="two", time_s=1.0, **near)
    )
    title = accurate_and_fast(methods, compared)
    assert title.startswith("one has the lowest error or ties at 1 of 1 setting; two takes the least median time at 1")


def test_a_biased_estimator_is_not_recommended_beside_a_far_lower_error_that_is_not_sure():
    """fobg 0.90 [0.87, 0.92] is tied with smoothing 0.17 [0.10, 1.7], whose interval is wide: no recommendation of fobg there."""
    exact = {"reference_norm": 1.0, "variance_low": 0.0, "variance_high": 0.0}
    biased = exact | {"rmse_rel": 0.9, "bias": 0.9, "bias_low": 0.87, "bias_high": 0.92}
    wide = exact | {"rmse_rel": 0.17, "bias": 0.17, "bias_low": 0.1, "bias_high": 1.7}
    good = exact | {"rmse_rel": 0.14, "bias": 0.14, "bias_low": 0.13, "bias_high": 0.15}
    _, _, texts = made(
        row(stiffness=1.0, estimator="fobg", **good), row(stiffness=1.0, estimator="smooth", **wide),
        row(stiffness=2.0, estimator="fobg", **biased), row(stiffness=2.0, estimator="smooth", **wide),
    )  # fmt: skip
    assert "fobg everywhere" not in texts[0]
    assert any("smooth may be better" in text and "more repeats" in text for text in texts)
