"""The study of errors: closed forms of descent, exclusions, ratios with their test over scenes, and a whole run."""

import math

import numpy as np
import pandas as pd
import pytest
from classes import Adam, GradientDescent, Planted, Quadratic
from dose_response import analysis, views
from dose_response.batched import run_batched
from dose_response.measure import compare
from dose_response.search import TARGETS, Method, Task, follow, run_searches, tune, unit_rate
from trees import ROOT

import bench
from bench.experiment import config
from bench.report.draw import draw

PAPER = ROOT / "examples" / "cost_of_error"
D = 8
DIFFERENCED = 1e-6
"""Relative error of gradients by central differences along a path."""


@pytest.fixture(scope="module")
def bowl():
    """A quadratic with one curvature, on which every step of descent has a closed form."""
    return bench.problem(Quadratic(dimension=D, condition=1.0), backend="numpy")


def task_of(problem, iterations=200):
    still = np.zeros((problem.program.n_noise, 1))
    return Task("quadratic", still, float(problem.value(problem.program.theta0, still)[0]), 0.0, iterations)


def curvature(problem):
    theta = problem.program.theta0
    return float(problem.grad(theta, np.zeros((D, 1)))[0, 0] / theta[0])


# ------------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("angle", [0.0, 30.0, 75.0])
def test_descent_along_a_rotated_gradient_takes_the_updates_of_its_closed_form(bowl, angle):
    """|x|^2 falls by 1 - 2 s cos(angle) + s^2 per step of s = rate times curvature."""
    share = 0.3
    method = Method(
        GradientDescent(rate=share / curvature(bowl)), Planted(base="best", angle=angle), 1, is_random=False
    )
    search = follow(bowl, method, task_of(bowl), seed=0)
    factor = 1 - 2 * share * math.cos(math.radians(angle)) + share**2
    expected = [math.ceil(math.log(k) / -math.log(factor) - 1e-9) for k in TARGETS]
    reachable = [e if e <= 200 else math.inf for e in expected]
    assert factor < 1
    assert search.updates == reachable


def test_tuning_finds_the_rate_that_solves_a_quadratic_in_one_step(bowl):
    """The rate 1 / curvature moves the largest element by its own size; the grid contains it once it is widened."""
    method = Method(GradientDescent(), Planted(base="best"), 1, is_random=False)
    gradient = bowl.grad(bowl.program.theta0, np.zeros((D, 1)))[:, 0]
    scale = unit_rate(method.optimizer, gradient)
    size = np.abs(bowl.program.theta0).max()
    found = tune(bowl, task_of(bowl, 60), method, [0], [scale * size * r for r in (0.01, 0.1)], widenings=3)
    assert all(found.is_inside)
    assert found.rates[found.best[-1]] == pytest.approx(1 / curvature(bowl), rel=DIFFERENCED)
    assert found.updates[found.best[-1]].tolist() == [1.0] * len(TARGETS)


def test_searches_in_shared_calls_equal_separate_searches(bowl):
    methods = [Method(Adam(rate=r), Planted(base="best", noise=1.0), 2) for r in (0.1, 0.5)]
    task = task_of(bowl, 40)
    together = run_searches(bowl, task, methods, [3, 4])
    apart = [follow(bowl, method, task, seed) for method, seed in zip(methods, [3, 4], strict=True)]
    assert [s.updates for s in together] == [s.updates for s in apart]


def test_the_error_of_one_of_the_searches_that_share_calls_is_raised(bowl):
    widths = [bowl.program.n_noise, bowl.program.n_noise + 1]
    searches = [lambda lane, width=width: lane.value(np.zeros(lane.dim), np.zeros((width, 1))) for width in widths]
    with pytest.raises(bench.UserError, match=r"noise w has the shape \(9, 1\)"):
        run_batched(bowl, searches)


def test_compare_splits_the_error_into_bias_and_spread():
    rng = np.random.default_rng(0)
    gradient = np.ones(50)
    estimates = gradient + 0.3 * np.eye(50)[0] * math.sqrt(50) + rng.standard_normal((20_000, 50)) * 0.2
    found = compare(estimates, gradient, 0.0)
    assert found["bias"] == pytest.approx(0.3, abs=0.01)  # 5 standard errors
    assert found["spread"] == pytest.approx(0.2, rel=0.01)
    assert found["error"] == pytest.approx(math.hypot(found["bias"], found["spread"]))


def test_an_unknown_gradient_gives_no_error_instead_of_a_small_one():
    found = compare(np.ones((4, 2)), np.array([1.0, 0.0]), variance=0.3)
    assert all(math.isnan(value) for value in found.values())


# ------------------------------------------------------------------------------------------------------- a whole run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dose")
    words = [
        "experiment=dose_response/quick",
        f"plugins={PAPER}",
        "backends=[numpy]",
        "scenes=[spring_record,double_integrator]",
        "workers=0",
        f"results_dir={folder}",
        "study=dose_response[iterations=8,seeds=1,tuning_seeds=1,widenings=1]",
        "repeats=4",
    ]
    return bench.run(words)


def test_planted_errors_of_a_run_have_their_size_on_the_common_path(run):
    table = analysis.searches(run)
    biased = table[table["kind"] == analysis.BIAS]
    turned = table[table["kind"] == analysis.ROTATION]
    assert biased["bias"].to_numpy() == pytest.approx(biased["dose"].to_numpy(), rel=1e-4)
    assert turned["error"].to_numpy() == pytest.approx(2 * np.sin(np.radians(turned["dose"].to_numpy()) / 2), rel=1e-4)


def test_problems_that_the_best_gradient_solves_in_a_few_updates_do_not_count():
    base = {"scene_class": "smooth", "target": 100.0, "error": 0.0, "kind": analysis.BEST}
    table = pd.DataFrame(
        [base | {"problem": name, "median": m} for name, m in (("easy", 2.0), ("fine", 9.0), ("hard", math.inf))]
    )
    known = analysis.floors(table).set_index("problem")["reason"]
    assert known["fine"] == ""
    assert known["easy"] == "the best gradient needs 2 updates"
    assert known["hard"] == "the best gradient misses the target"


# ------------------------------------------------------------------------------------------------ without a model


@pytest.mark.parametrize(("n", "low", "high"), [(5, 0, math.inf), (6, 1, 6), (8, 1, 8), (9, 2, 8), (25, 8, 18)])
def test_interval_of_a_median_has_the_order_statistics_of_the_tables(n, low, high):
    """Of n values the k-th from either end, with k from the sign test at 5% (Conover 1999, Practical Nonparametric Statistics); five leave it open."""
    values = np.random.default_rng(0).permutation(np.arange(1.0, n + 1))
    assert analysis.median_interval(values) == ((n + 1) / 2, low, high)


def planted(scene, kind, dose, updates, problem=""):
    return {
        "problem": f"{scene}{problem}",
        "scene": scene,
        "scene_class": "smooth",
        "kind": kind,
        "method": kind,
        "dose": dose,
        "error": dose,
        "target": 100.0,
        "median": updates,
    }


def compared(lines, comparison, scene_class="smooth"):
    found = analysis.by_scene(analysis.ratios(pd.DataFrame(lines)))
    return found.set_index(["scene_class", "comparison"]).loc[(scene_class, comparison)]


def test_ratios_are_those_of_the_same_problem_and_missed_targets_count():
    lines = (
        [planted(f"p{i}", analysis.RANDOM, 0.3, 10.0 * i) for i in range(1, 8)]
        + [planted(f"p{i}", analysis.RANDOM, 3.0, 40.0 * i if i < 6 else math.inf) for i in range(1, 8)]
        + [planted(f"p{i}", analysis.RANDOM, 1.0, math.inf if i == 7 else 20.0 * i) for i in range(1, 8)]
        + [planted(f"p{i}", analysis.BIAS, 0.9, math.inf if i == 7 else 60.0 * i) for i in range(1, 8)]
    )
    tenfold = compared(lines, "random error 3 / 0.3")
    assert (tenfold["ratio"], tenfold["ratio_low"], tenfold["ratio_high"]) == (4.0, 4.0, math.inf)
    both = compared(lines, "bias 0.9 / random error 1")
    assert (both["problems"], both["ratio"], both["ratio_low"], both["ratio_high"]) == (6, 3.0, 3.0, 3.0)
    assert both.equals(compared(lines, "bias 0.9 / random error 1", analysis.ALL))


@pytest.mark.parametrize(("scenes", "verdict"), [(6, "above 1"), (5, "not known")])
def test_a_verdict_counts_scenes_and_not_problems(scenes, verdict):
    """Forty problems with the same outcome are no evidence if they are of five scenes: a fair coin gives that in one of 16."""
    lines = [
        planted(f"s{i % scenes}", kind, dose, updates, f", T={i}")
        for i in range(40)
        for kind, dose, updates in ((analysis.RANDOM, 0.3, 10.0), (analysis.RANDOM, 3.0, 20.0 + i))
    ]
    line = compared(lines, "random error 3 / 0.3")
    assert (line["problems"], line["scenes"], line["above"], line["verdict"]) == (40, scenes, scenes, verdict)


def test_planted_errors_alone_have_a_report_that_compares_no_orders(run):
    """The fault: without natural methods the tables of costs had no columns, and the report ended in a KeyError."""
    experiment = config.load(["experiment=dose_response/quick", f"plugins={PAPER}"])
    for rows in (run[run["estimator"] == "planted"], run[run["estimator_params"] == "base=best"]):
        shown = views.views(experiment, rows.reset_index(drop=True))
        (pairs,) = [table for table in shown.tables if table.name in ("pairs", "problems")][:1]
        assert "first order" not in pairs.frame.to_csv()


@pytest.mark.parametrize(("ratio", "edge"), [(math.inf, 1.0), (0.0, 0.0)])
def test_what_the_answer_names_is_first_and_a_ratio_without_a_number_a_cross_at_the_edge(ratio, edge):
    """Seventeen comparisons stood in one list, and an axis of logarithms dropped the strongest."""
    ratios = [[f"s{i}", name, r] for i in range(6) for name, r in (("random error 3 / 0.3", 9.0), ("bias 0.6", ratio))]
    lines = pd.DataFrame(ratios, columns=["scene", "comparison", "ratio"]).assign(scene_class="", target=100.0)
    chart = views._ratios(analysis.by_scene(lines).query("scene_class == ''"), 'comparison="bias 0.6"')
    assert chart.frame["row"].tolist() == ["bias 0.6 (6)", "random error 3 / 0.3 (6)"]
    crosses = [line.get_xdata() for line in draw(chart).axes[0].lines if line.get_marker() == "x"]
    assert np.concatenate(crosses).tolist() == [edge]


@pytest.mark.parametrize("last", [6.0, math.inf])
def test_the_range_of_searches_has_those_that_miss(last):
    line = planted("p", analysis.COSTS_ONLY, 0.0, 5.0) | {"rollouts_per_update": 2.0, "gradients_per_update": 0.0}
    found = analysis.reached(pd.DataFrame([line | {"times": np.array([4.0, 5.0, last])}]))
    assert found[["fewest", "evaluations", "most"]].to_numpy().tolist() == [[8.0, 10.0, 2 * last]]
