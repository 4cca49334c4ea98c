"""The fastest method for an error: costs at a known law of bias and variance."""

import math

import pandas as pd
import pytest
from bench.plugins.studies.bias_variance.time_to_accuracy import (
    ROLLOUTS,
    TIME,
    RequiredCost,
    lead,
    limits,
    required_cost,
    with_gradient_cost,
)
from bench.plugins.studies.bias_variance.time_to_accuracy import table as table_of
from helpers import row

from bench.cli import main
from bench.experiment import config
from bench.measure.statistics import UNEXPLAINED
from bench.report.views import arrange

SAMPLES = (16, 64, 256)
VARIANCE = 4.0
"""Of one sample, relative: an RMSE of 0.1 takes 400 samples and one of 0.5 takes 16."""


def rows(bias=0.0, resolved=None, **values):
    """Rows of a method with that law, 1 ms a sample, for a gradient of norm 2."""
    resolved = bias > 0 if resolved is None else resolved
    return pd.DataFrame(
        [
            row(
                **{
                    "backend": "b",
                    "estimator": "e",
                    "draws": "iid",
                    "repeats": 8,
                    "samples": float(n),
                    "reference_norm": 2.0,
                    "bias": 2 * bias,
                    "bias_low": 1.9 * bias if resolved else 0.0,
                    "bias_high": 2.1 * bias,
                    **dict.fromkeys(("variance", "variance_low", "variance_high"), 4 * VARIANCE / n),
                    "rmse": 2 * math.sqrt(bias**2 + VARIANCE / n),
                    "rmse_rel": math.sqrt(bias**2 + VARIANCE / n),
                    "time_s": 1e-3 * n,
                    "time_iqr_s": 0.0,
                    "rollouts": float(n),
                    "gradients": float(n),
                }
                | values
            )
            for n in SAMPLES
        ]
    )


GIVEN = config.load(["sweep.samples=[16,64,256]"])


def table(*parts, width=1.0):
    """The table of some rows, whose variances have intervals ``width`` times up and down."""
    found = pd.concat(parts, ignore_index=True)
    found = found.assign(variance_low=found["variance"] / width, variance_high=found["variance"] * width)
    return table_of(arrange(GIVEN, with_gradient_cost(found)))


def entry(*parts, by="rollouts", target=0.1, width=1.0):
    found = table(*parts, width=width)
    return found[(found["by"] == by) & (found["relative error"] == target)].iloc[0]


def line(**values):
    return rows(**values).assign(x=SAMPLES).pipe(with_gradient_cost)


@pytest.mark.parametrize(
    ("target", "how", "samples"),
    [
        (0.5, "at once", 16),
        (math.sqrt(4 / 100), "measured", 100),
        (0.1, "extrapolated", 400),
        (0.01, "extrapolated", 40_000),
    ],
)
def test_unbiased_methods_follow_the_law(target, how, samples):
    found = required_cost(line(), target, TIME)
    assert found.how == how
    assert found.samples == pytest.approx(samples)
    assert found.cost == pytest.approx(1e-3 * samples)
    assert required_cost(line(), target, ROLLOUTS).cost == pytest.approx(2 * samples)


def test_work_that_does_not_grow_with_samples_is_not_extrapolated():
    found = required_cost(line(rollouts=1.0, gradients=0.0), 0.1, ROLLOUTS)
    assert (found.how, found.beyond) == ("unknown", 1.0)


def test_the_cheapest_sufficient_samples_are_taken_not_the_fewest():
    """Where 16 samples take 120 us and 256 take 64 us, both within the error, the answer is 64 us."""
    found = required_cost(line().assign(time_s=[120e-6, 200e-6, 64e-6]), 0.6, TIME)
    assert (found.cost, found.samples) == (64e-6, 256)


def test_a_gradient_costs_what_it_takes():
    """Gradients at 3 ms and rollouts at 1 ms each: 16 gradients are 48 rollouts, the estimator with both 64."""
    first = rows(rollouts=0.0).assign(time_s=lambda r: 3e-3 * r["gradients"])
    zeroth = rows(gradients=0.0, estimator="z")
    found = with_gradient_cost(
        pd.concat([first, zeroth, rows(estimator="both"), rows(backend="other")], ignore_index=True)
    )
    assert found[ROLLOUTS].tolist()[::3] == pytest.approx([48, 16, 64, 32])


def test_without_times_only_rollouts_are_ranked_and_numbers_are_numbers():
    found = table(rows(time_s=math.nan))
    assert set(found["by"]) == {"rollouts"}
    assert [str(found[name].dtype) for name in ("relative error", "cost", "factor")] == ["float64"] * 3


@pytest.mark.parametrize(
    ("given", "how"),
    [
        ({"bias": 0.06}, "extrapolated"),
        ({"bias": 0.2}, "never"),
        ({"bias": 0.2, "reason": f"declared unbiased: {UNEXPLAINED}"}, "unknown"),
        ({"bias": 0.1, "resolved": False}, "unknown"),
        ({"bias": 0.01, "resolved": False}, "extrapolated"),
        ({"status": "nonfinite"}, "unknown"),
    ],
)
def test_a_bias_decides_whether_an_error_of_10_percent_is_reached(given, how):
    """A bias below the error takes more samples; where it is not known, the cost is at least that without bias."""
    found = required_cost(line(**given), 0.1, TIME)
    assert found.how == how
    if how == "extrapolated":
        assert found.samples == pytest.approx(VARIANCE / (0.1**2 - given["bias"] ** 2), rel=0.02)
    if given.get("bias") == 0.1:
        assert found.beyond == pytest.approx(0.4)


def test_samples_beyond_the_measured_ones_cost_more_than_these():
    """Without the bias of 8%, which may be 0, the variance would reach 10% with 200 samples, and 256 did not."""
    found = required_cost(line(bias=0.08, resolved=False).assign(variance=8 / 256, rmse_rel=0.12), 0.1, TIME)
    assert (found.samples, found.cost) == (256, 0.256)


@pytest.mark.parametrize("given", [{"estimator": "quadratic_model"}, {"draws": "sobol"}])
def test_samples_that_are_coupled_are_not_extrapolated(given):
    """The error of such an estimator need not fall as the root of 1 / N: only measured counts tell."""
    curve = line(**given)
    beyond = required_cost(curve, 0.1, ROLLOUTS)
    assert (beyond.how, beyond.beyond) == ("unknown", 512)
    assert math.isnan(beyond.cost)
    assert required_cost(curve, 0.2, TIME).samples == pytest.approx(100)


def better(times, **values):
    """Rows whose error is smaller by a factor."""
    return rows(**values).assign(rmse_rel=lambda r: r["rmse_rel"] / times, variance=lambda r: r["variance"] / times**2)


def slower(times, **values):
    return rows(**values).assign(time_s=lambda r: times * r["time_s"])


def test_an_estimator_beyond_the_measured_samples_leaves_the_order_open():
    """The first takes 800 rollouts; the other has half the error at 256 samples, and more than 512 rollouts to go."""
    found = entry(rows(), better(1 / 0.9, estimator="quadratic_model"), width=1.01)
    names = tuple(found[["fastest", "next", "tied", "unknown"]])
    assert names == ("e", "quadratic_model", ("quadratic_model",), "quadratic_model")
    assert limits(pd.DataFrame([found])) == ["not known"]


def test_an_estimator_beyond_the_measured_samples_is_behind_one_that_needs_fewer():
    """A hundredth of the variance takes 4 samples for 0.1: measured at 16, and the other takes more than 512 rollouts."""
    found = entry(better(3), rows(estimator="quadratic_model"), width=1.01)
    assert math.isnan(found["factor"])
    assert found["factor_low"] == pytest.approx(512 / (800 / 9), rel=0.05)


def test_a_cost_at_the_fewest_samples_is_a_limit():
    """The first reaches 50% with 16 samples and may with fewer, the other with 64: at least 4 times, less the interval."""
    found = entry(better(10, estimator="quick"), rows(estimator="slow"), width=1.001)
    assert found["how"] == "at once"
    assert (math.isnan(found["factor"]), found["factor_high"]) == (True, math.inf)
    assert limits(pd.DataFrame([found])) == ["at least 25"]


TWO, THREE = math.log(2), math.log(3)


@pytest.mark.parametrize(("first", "second"), [((TWO, THREE), (0, 0)), ((0, 0), (THREE, TWO))])
def test_a_lead_is_as_uncertain_as_each_cost_and_to_the_same_side(first, second):
    """A first cost of up to 3 times itself, or a second of down to a third, makes the lead of 6 as many times less."""
    costs = [RequiredCost("measured", cost, down=down, up=up) for cost, (down, up) in ((2.0, first), (12.0, second))]
    assert lead(*costs) == pytest.approx((6.0, 2.0, 12.0))


def test_an_error_that_no_method_is_known_to_reach_may_not_be_never_reached():
    biased = rows(bias=0.3)
    assert entry(biased)["how"] == "never"
    assert entry(biased, rows(estimator="quadratic_model"))["how"] == "not known"


@pytest.mark.parametrize(("width", "tied"), [(1.0, ()), (1.2, ()), (3.0, ("slow on b",))])
def test_the_table_names_the_fastest_and_a_factor_only_where_its_interval_excludes_1(width, tied):
    found = entry(rows(), slower(3, estimator="slow"), rows(bias=0.3, estimator="biased"), by="time", width=width)
    assert (found["fastest"], found["next"], found["how"]) == ("e on b", "slow on b", "extrapolated")
    assert found["factor"] == pytest.approx(3.0)
    assert found["never"] == "biased on b"
    assert (found["factor_low"] > 1.0, found["tied"]) == (not tied, tied)


def test_nothing_is_told_where_samples_are_not_swept():
    assert table(rows()[:1]).empty


def test_an_error_far_above_all_variances_leaves_no_doubt_about_the_times():
    """Both reach it with their smallest batch and more: only their times differ, however uncertain their variances."""
    tiny = {"variance": 1e-9, "rmse": 1e-4, "rmse_rel": 5e-5}
    parts = rows(time_s=1e-3, **tiny), rows(time_s=3e-3, estimator="slow", **tiny)
    assert list(entry(*parts, by="time", width=50.0)[["factor", "factor_low", "factor_high"]]) == pytest.approx(
        [3.0] * 3
    )
    # by rollouts both costs are upper limits: one sample of either may do
    assert entry(*parts, width=50.0)["tied"] == ("slow",)


def test_the_next_is_another_estimator():
    parts = rows(), slower(2, backend="other")
    assert entry(*parts, by="time")["next"] == "-"
    assert entry(*parts, slower(3, estimator="slow"), by="time", width=1.1)["next"] == "slow on b"


def test_a_sweep_of_samples_in_which_a_scene_fails_has_its_report(tmp_path):
    words = [
        "scenes=[callable,quadratic]",
        "estimators=[sphere_smoothing]",
        "backends=[numpy]",
        "sweep.samples=[4,5]",
        "repeats=3",
    ]
    assert main([*words, "workers=0", "timing=false", "--quiet", "name=failed", f"results_dir={tmp_path}"]) == 0
    assert (tmp_path / "failed" / "report.html").exists()
