"""Comparisons of the main study: computed a second way from the committed tables, and on planted rows."""

import math

import numpy as np
import pytest
from bench.plugins.studies.bias_variance.comparisons import (
    FAILS,
    NO_RESULT,
    OPEN,
    WORKS,
    at_equal_rollouts,
    compare_errors,
    declares,
    lowest,
    method_table,
    problems_by_axis,
    ratio,
    verdict,
)
from bench.plugins.studies.bias_variance.time_to_accuracy import with_gradient_cost
from helpers import charts_of, failed, row, swept, table

from bench.errors import UserError
from bench.experiment import config
from bench.report.cells import readable
from bench.report.draw import draw
from bench.report.figures import styled
from bench.report.views import arrange


def cell(error, low, high, **values):
    """A row whose relative RMSE has exactly this interval, with bias 0."""
    norm = 4.0
    made = row(**values)
    return made | {
        "bias": 0.0,
        "bias_low": 0.0,
        "bias_high": 0.0,
        "rmse_rel": error,
        "rmse": norm * error,
        "variance": (norm * error) ** 2,
        "variance_low": (norm * low) ** 2,
        "variance_high": (norm * high) ** 2,
    }


def near(error, share=0.1, **values):
    """A row whose relative RMSE is known to a share of itself."""
    return cell(error, (1 - share) * error, (1 + share) * error, **values)


def made(*cells, **given):
    """Methods and comparisons of cells along the stiffness."""
    rows = with_gradient_cost(table(list(cells)))
    methods = method_table(problems_by_axis(arrange(swept(rows, **given), rows)))
    return methods, compare_errors(at_equal_rollouts(methods))


# ------------------------------------------------------------------------------------ verdicts and comparisons


@pytest.mark.parametrize(
    ("status", "error", "low", "high", "expected"),
    [
        ("ok", 0.5, 0.4, 0.6, WORKS),
        ("ok", 1.3, 0.65, 2.4, OPEN),
        ("ok", 2.0, 1.5, 3.0, FAILS),
        ("ok", math.nan, math.nan, math.nan, OPEN),
        ("ok", 2.0, 1.5, math.inf, FAILS),
        ("ok", 0.5, 0.1, math.inf, OPEN),
        ("ok", 0.5, math.nan, 0.6, OPEN),
        ("ok", 2.0, 1.5, math.nan, OPEN),
        ("nonfinite", math.nan, math.nan, math.nan, NO_RESULT),
    ],
)
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


@pytest.mark.parametrize(("first", "second"), [((2, 1, 12), (6, 6, 6)), ((2, 2, 2), (6, 1, 12))])
def test_the_ends_of_a_factor_are_as_far_as_those_of_the_uneven_interval(first, second):
    """A first value of up to 6 times itself, or a second of down to a sixth, makes the factor of 3 as many times less."""
    assert np.array(ratio(first, second)) == pytest.approx([3.0, 0.5, 6.0])


@pytest.mark.parametrize(("high", "found"), [(0.19, {"fobg"}), (0.21, set())])
def test_the_lowest_interval_is_apart_from_those_of_other_estimators(high, found):
    methods, _ = made(
        cell(0.1, 0.09, high, stiffness=1e2, estimator="fobg"), cell(0.3, 0.2, 0.4, stiffness=1e2, estimator="b")
    )
    assert {name for _, name in lowest(methods)} == found
    # a cost and a gradient of each sample
    assert methods["evaluations"].tolist() == [2.0, 1.0]


def test_methods_are_tied_unless_the_interval_of_their_factor_is_above_1():
    _, compared = made(
        *(
            near(e, stiffness=k, estimator=n, gradients=0)
            for k in (1e2, 1e4)
            for n, e in (("fobg", 0.10), ("reinforce", 0.105), ("finite_difference", 0.4))
        )
    )
    assert list(compared["first"]) == ["fobg", "fobg"]
    assert list(compared["tied"]) == [("reinforce",)] * 2
    assert (compared["factor_low"] < 1).all()


def test_a_missing_interval_cannot_be_first_and_an_unresolved_reference_is_open():
    methods, compared = made(
        *(cell(0.05, math.nan, math.nan, stiffness=k, estimator="fobg") for k in (1e2, 1e4)),
        *(cell(0.3, 0.2, 0.4, stiffness=k, estimator="reinforce") for k in (1e2, 1e4)),
    )
    assert set(methods.loc[methods["estimator"] == "fobg", "verdict"]) == {OPEN}
    assert list(compared["first"]) == ["reinforce", "reinforce"]


def test_a_failed_cell_fails_its_estimator_and_a_refused_one_does_not():
    methods, _ = made(
        *(cell(0.1, 0.09, 0.11, stiffness=k) for k in (1e2, 1e4)),
        cell(0.3, 0.2, 0.4, stiffness=1e2, estimator="reinforce"),
        failed("nonfinite", "1 of 32 estimates are not finite", stiffness=1e4, estimator="reinforce"),
        failed("unsupported", "it cannot", stiffness=1e2, estimator="finite_difference"),
    )
    verdicts = methods.groupby("estimator")["verdict"].agg(list).to_dict()
    assert verdicts == {"fobg": [WORKS, WORKS], "reinforce": [WORKS, NO_RESULT]}


def by_samples(estimator, rollouts, gradients=0.0, scale=1.0):
    """Cells whose error is ``scale`` over the root of N, with some rollouts and gradients per sample."""
    return [
        near(
            scale / math.sqrt(n),
            0.01,
            estimator=estimator,
            samples=n,
            rollouts=rollouts * n + 0.01,
            gradients=gradients * n,
        )
        for n in (64, 128)
    ]


def test_costs_of_several_rollouts_per_sample_are_compared_at_equal_rollouts():
    """At equal samples `b` has 1 / 1.2 of the error of `a`, at equal rollouts 1.18 times."""
    cells = [*by_samples("fobg", 1), *by_samples("reinforce", 2, scale=1 / 1.2)]
    _, compared = made(*cells, sweep={"samples": [64, 128]})
    assert compared[["axis", "at", "first", "second"]].values.tolist() == [
        ["rollouts", at, "fobg", "reinforce"] for at in (128.0, 256.0)
    ]
    assert compared["factor"].tolist() == pytest.approx([math.sqrt(2) / 1.2] * 2, rel=1e-3)


def test_a_fact_that_depends_on_parameters_is_that_of_the_plugin():
    rows = table([row(estimator="reinforce"), row(estimator="randomized_smoothing")])
    assert declares(rows, "separable").tolist() == [False, True]


RESCALED = {0.0: math.sqrt(2.0), 0.2: math.hypot(0.2, 0.3 * math.sqrt(2.0)) / math.hypot(0.2, 0.3)}


@pytest.mark.parametrize("bias", RESCALED)
def test_at_one_number_of_samples_variances_are_rescaled_and_biases_stay(bias):
    """Both have the same error at 100 samples, which are 100 and 200 rollouts."""
    given = {"bias": 4 * bias, "bias_low": 3.9 * bias, "bias_high": 4.1 * bias}
    _, compared = made(*(of(name, n, **given) for name, n in (("fobg", 100), ("randomized_smoothing", 200))))
    assert compared[["first", "rollouts"]].values.tolist() == [["fobg", 100]]
    assert compared["factor"].item() == pytest.approx(RESCALED[bias])


def of(name, rollouts, error=0.3, **values):
    """A row of an estimator at one stiffness that takes so many rollouts."""
    return near(error, 0.05, stiffness=1e2, rollouts=rollouts, gradients=0, estimator=name) | values


@pytest.mark.parametrize(
    ("estimator", "given"),
    [
        ("randomized_smoothing", {"draws": "sobol"}),
        ("inverse_variance", {"bias": 0.4, "bias_low": 0.3, "bias_high": 0.5}),
    ],
    ids=["coupled samples", "weights by sample"],
)
def test_where_no_law_gives_the_error_at_equal_rollouts_that_at_fewer_stands(estimator, given):
    """Fewer rollouts than all may take are allowed, and the most that a method takes are the rollouts of the comparison."""

    _, compared = made(of(estimator, 200, **given), of("fobg", 100, 0.1))
    assert compared[["first", "rollouts"]].values.tolist() == [["fobg", 200]]
    _, compared = made(of(estimator, 200, **given), of("reinforce", 100, 0.1, draws="orthogonal"))
    assert compared[["first", "rollouts", "not_comparable"]].values.tolist() == [["reinforce", 200, ()]]


def test_a_method_is_not_beaten_by_one_that_is_scaled_above_its_own_rollouts():
    """With as many rollouts its error might be lower, so it ties; with a lower error at fewer rollouts it is first."""

    _, compared = made(of("reinforce", 100, 0.3, draws="sobol"), of("fobg", 100, 0.3), of("guided", 400, 0.9))
    assert compared[["first", "rollouts", "tied"]].values.tolist() == [["fobg", 400, ("reinforce",)]]
    _, compared = made(of("reinforce", 100, 0.1, draws="sobol"), of("fobg", 100, 0.3), of("guided", 400, 0.9))
    assert compared["first"].item() == "reinforce"


FIXED = "plain_difference"


@pytest.mark.parametrize(("rollouts", "compared_at"), [(100.0, 128.0), (200.0, 200.0)])
def test_costs_that_do_not_grow_with_samples_are_compared_where_the_rollouts_suffice(rollouts, compared_at):
    fixed = [one | {"rollouts": rollouts} for one in by_samples(FIXED, 1, scale=0.1)]
    _, compared = made(*by_samples("a", 1), *by_samples("b", 2), *fixed, sweep={"samples": [64, 128]})
    expected = [["rollouts", compared_at, FIXED], ["rollouts", 256.0, FIXED]]
    assert compared[["axis", "at", "first"]].values.tolist() == expected


def test_a_method_of_one_rollout_does_not_decide_the_rollouts_of_a_comparison():
    """One call without noise may use no more, so others are compared with it at the rollouts that they take."""
    cells = of("fobg", 100, 0.1), of("randomized_smoothing", 200, 0.2), of("plain", 1)
    assert made(*cells)[1][["first", "rollouts"]].values.tolist() == [["fobg", 100]]


def test_a_far_larger_error_does_not_share_the_first_place_of_an_error_that_is_not_sure():
    """fobg 0.90 [0.87, 0.92] is tied with smoothing 0.17 [0.10, 1.7], whose interval is wide: fobg is no leader there."""
    exact = {"reference_norm": 1.0, "variance": 0.0, "variance_low": 0.0, "variance_high": 0.0}
    biased = exact | {"rmse_rel": 0.9, "bias": 0.9, "bias_low": 0.87, "bias_high": 0.92}
    wide = exact | {"rmse_rel": 0.17, "bias": 0.17, "bias_low": 0.1, "bias_high": 1.7}
    good = exact | {"rmse_rel": 0.14, "bias": 0.14, "bias_low": 0.13, "bias_high": 0.15}
    _, compared = made(
        row(stiffness=1.0, estimator="fobg", **good),
        row(stiffness=1.0, estimator="smooth", **wide),
        row(stiffness=2.0, estimator="fobg", **biased),
        row(stiffness=2.0, estimator="smooth", **wide),
    )
    assert list(compared["leaders"]) == [("fobg", "smooth"), ("smooth",)]


def vague(low, high, **values):
    """A row without a distinguishable bias whose reference errs more than the estimates spread: an upper limit of the RMSE."""
    return cell(0.01, low, 0.02, **values) | {"bias_high": 4.0 * high, "reference_se": 0.2}


def test_an_upper_limit_is_shown_and_never_first_nor_bold():
    """It was 0, dropped by log axes, or first by the luck of the reference's error."""
    cells = [
        *(vague(0.001, 0.1, stiffness=k, estimator="fobg") for k in (1e2, 1e4)),
        *(near(e, stiffness=k, estimator="reinforce") for k, e in ((1e2, 0.1), (1e4, 0.3))),
    ]
    methods, compared = made(*cells)
    assert list(compared["first"]) == ["reinforce", ""], "the limit is below the other's interval at 1e4"
    assert list(compared["tied"]) == [("fobg",)] * 2
    assert list(compared["leaders"]) == [("reinforce", "fobg"), ("fobg",)]
    assert compared["factor"].isna().all()
    limit = math.hypot(0.1, 0.02)
    assert methods.loc[methods["error_is_limit"], "error"].tolist() == pytest.approx([limit] * 2)
    shown = swept(rows := table(cells))
    views = shown.study.views(shown, rows)
    main, chart = views.tables[0], next(one for one in views.charts if one.name == "bias_variance_stiffness")
    assert readable(main).iloc[0, 1:3].tolist() == ["< 0.10"] * 2
    assert not any(main.frame[f"x{i}_best"].any() for i in (0, 1))
    drawn = chart.frame[chart.frame["series"] == "fobg"]
    assert drawn["rmse_limit"].all()
    assert drawn["rmse_rel"].tolist() == pytest.approx([limit] * 2)


def test_a_lucky_estimate_equal_to_an_exact_reference_is_a_limit_too():
    """Identical estimates leave room for a rare event, so their error is not 0."""
    exact = {
        "bias": 0.0,
        "bias_low": 0.0,
        "bias_high": 0.04,
        "variance": 0.0,
        "variance_low": 0.0,
        "variance_high": 1e-4,
    }
    methods, compared = made(
        row(reference_norm=1.0, stiffness=1e2, **exact), cell(0.3, 0.2, 0.4, stiffness=1e2, estimator="b")
    )
    assert methods["error"].iloc[0] == pytest.approx(math.hypot(0.04, 0.01))
    assert compared[["first", "tied"]].values.tolist() == [["", ("fobg",)]]


# ------------------------------------------------------------------------------------------ what to use, and what fails


def recommended(*cells):
    """What to use per range of the stiffness."""
    rows = table(list(cells))
    shown = swept(rows)
    (found,) = (one for one in shown.study.views(shown, rows).tables if one.name == "recommendations")
    return found.frame


def test_what_does_not_work_is_never_recommended():
    """The lowest error was recommended also at 1.13 times the gradient, where every interval lies above 1."""
    errors = {"fobg": (0.1, 1.3, 1.02, 0.95), "reinforce": (0.5, 3.0, 1.4, 0.5)}
    cells = [
        near(e, stiffness=k, estimator=name, gradients=0)
        for name, some in errors.items()
        for k, e in zip((1e1, 1e2, 1e3, 1e4), some, strict=True)
    ]
    found = recommended(*cells)
    assert found["use"].tolist() == ["fobg", "none works", "none is known to work", "reinforce"]
    assert found["error"].tolist() == ["0.10", "-", "-", "0.50"]


def test_of_backends_that_differ_only_those_are_recommended_whose_error_is_small():
    errors = {"jax": 0.1, "mujoco": 1.5}
    found = recommended(*(near(e, backend=b, estimator="fobg") for b, e in errors.items()))
    assert found["use"].tolist() == ["fobg (jax)"]


def test_an_estimate_that_is_always_0_fails():
    """The gradient of a step's program: its error is 1 by definition, however uncertain the reference is."""
    zero = {
        "grad_norm": 0.0,
        "variance": 0.0,
        "variance_low": 0.0,
        "variance_high": 1e-4,
        "reference_norm": 1.0,
        "reference_se": 1e-4,
        "bias": 1.0,
        "bias_low": 0.9999,
        "bias_high": 1.0001,
        "rmse_rel": 1.0,
        "rmse": 1.0,
    }
    methods, _ = made(row(stiffness=1e2, **zero), row(stiffness=1e4, **zero | {"grad_norm": 2.0}))
    assert methods["verdict"].tolist() == [FAILS, OPEN]


# ------------------------------------------------------------------------------------------------- what charts compare


def along(errors, **given):
    """Cells along three stiffnesses with an error per backend."""
    return [near(e, stiffness=k, backend=b, time_s=t, **given) for k in (1e2, 1e3, 1e4) for b, (e, t) in errors.items()]


def test_a_chart_shows_the_backends_that_its_experiment_compares():
    """A question about engines was answered by the fastest backend, the minimal model."""
    cells = along({"jax": (0.1, 1e-3), "mujoco": (0.1, 1.0), "mjx": (0.3, 0.1)})
    chart = charts_of(table(cells), compares={"backends": ["jax", "mujoco"]})["bias_variance_stiffness"]
    assert set(chart.frame["series"]) == {"jax", "mujoco"}


def test_a_backend_that_differs_is_a_line_of_its_own():
    """Of 1.5e5 on one backend and 600 on another, only the first was drawn."""
    chart = charts_of(table(along({"jax": (0.1, 1e-3), "numpy": (0.4, 1.0)})))["bias_variance_stiffness"]
    assert set(chart.frame["series"]) == {"fobg", "fobg (numpy): over 3% apart"}


def test_time_to_an_error_is_drawn_per_backend_that_is_compared_and_with_what_never_arrives():
    samples, sigmas = [16, 64, 256, 1024], [0.1, 0.3]
    never = {"bias": 2.0, "bias_low": 1.9, "bias_high": 2.1}
    cells = [
        near(
            share * n**-0.5,
            samples=n,
            sigma=s,
            backend=b,
            estimator=name,
            time_s=t * n,
            time_iqr_s=0.0,
        )
        | bias
        for s in sigmas
        for n in samples
        for b, t in (("jax", 1e-5), ("mjx", 1e-3))
        for name, share, bias in (
            ("fobg", 1, {}),
            ("plain", 0.1, {}),
            ("inverse_variance", 1, never | {"rmse_rel": 0.5}),
        )
    ]
    given = {"sweep": {"samples": samples, "sigma": sigmas}, "compares": {"backends": ["jax", "mjx"]}}
    chart = charts_of(table(cells), **given)["speed_accuracy"]
    assert (chart.kind, chart.failed_name) == ("grid", "not known to be reached")
    first = "first, or tied: the 95% interval of its factor to the first reaches 1"
    found = [
        ("jax", "fobg", "1 ms", "below 10 times the first"),
        ("mjx", "fobg", "100 ms", "10 or more times the first"),
        ("jax", "plain", "<160 µs", first),
        ("mjx", "plain", "<16 ms", "<: an upper limit, 10 or more times the first"),
    ]
    assert chart.frame[["panel", "series", "cell", "grade"]].to_numpy().tolist() == [
        [f"{backend}, sigma={s}", *line] for s in sigmas for backend, *line in found
    ]


def test_the_contact_laws_that_an_experiment_compares_are_lines_and_samples_cost_time():
    """How much longer implicit contact takes with few and with many samples was asked, and the time to an error drawn."""
    laws = "penalty", "complementarity[kappa=1e-06]"
    cells = [cell(0.1, 0.09, 0.11, samples=n, contact=law, time_s=1e-5 * n) for n in (1, 10, 100) for law in laws]
    given = {"sweep": {"samples": [1, 10, 100]}, "compares": {"contacts": ["penalty", "complementarity"]}}
    chart = charts_of(table(cells), **given)["time_samples"]
    assert (chart.y[0].name, list(chart.styles)) == ("time_s", [f"{law} on jax" for law in laws])
    assert chart.styles[f"{laws[1]} on jax"].meaning == "complementarity on jax: implicit contact"


def test_two_values_of_an_axis_are_joined_by_an_arrow_and_below_are_the_costs_of_the_same_rollouts():
    """That costs look normal where a gradient is off by 1e5 was said, and not drawn. They are of rows that use costs."""
    given = {"sweep": {"stiffness": [1e2, 1e3, 1e4]}, "compares": {"stiffness": [1e2, 1e4], "estimators": ["fobg"]}}
    cells = along({"jax": (0.1, 1e-3)})
    assert len(charts_of(table(cells), **given)["contrast"].y) == 1
    costs = [
        one | {"cost": one["stiffness"], "cost_low": 1.0, "cost_high": 2e4}
        for one in along({"jax": (0.2, 1e-3)}, estimator="reinforce")
    ]
    chart = charts_of(table([*cells, *costs]), **given)["contrast"]
    assert chart.frame["series"].unique().tolist() == ["fobg"]
    assert chart.frame["cost"].tolist() == chart.frame["stiffness"].tolist() == [1e2, 1e4]
    with styled():
        figure = draw(chart)
    errors, below = figure.axes
    assert errors.get_xlim() == below.get_xlim()
    assert chart.subtitle.endswith(
        "stiffness 100 to 10,000 N/m changes the costs by at most 200%: only the errors tell"
    )
    assert "95% of the rollouts" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_what_a_command_line_chooses_is_drawn_whatever_the_file_compares():
    named = ["experiment=smoothing_sweep"]
    assert "estimators" in config.load(named).compares
    assert "estimators" not in config.load([*named, "estimators=[fobg,reinforce]"]).compares


def test_an_unknown_axis_of_a_comparison_is_refused():
    with pytest.raises(UserError, match="unknown axis in compares 'stifness'"):
        charts_of(table(along({"jax": (0.1, 1e-3)})), compares={"stifness": [1e2, 1e4]})
