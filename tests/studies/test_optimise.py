"""The study of searches: known optima, stops, refusals, tables and charts, and the statistics that sum them up."""

import math

import numpy as np
import pandas as pd
import pytest
from bench.plugins.studies.optimise import measure as measured_by
from bench.plugins.studies.optimise import views as studied
from bench.plugins.studies.optimise.measure import scene_class, stored_indices
from bench.plugins.studies.optimise.solve import solve
from classes import ExplicitEuler, Impulse, Lqr, Penalty, SemiImplicitEuler, TwoBalls
from helpers import loaded

import bench
from bench.cli import main
from bench.experiment import config
from bench.measure import performance
from bench.run.session import RunSession

CHECKED = 1e-6
"""Relative agreement with the checked optima."""


# --------------------------------------------------------------------------------------------------- known optima


def test_regulator_knows_its_optimum_and_value():
    problem = bench.problem("lqr[horizon=12]", backend="numpy")
    scene = problem.program.scene
    found = solve(problem)
    assert found.certified
    assert found.cost == pytest.approx(scene.optimum(None, SemiImplicitEuler())[0], rel=CHECKED)
    path = problem.trajectory(found.theta, np.zeros((12, 1))).states[:, :, 0]
    # what is left to pay on the optimal path is the value of the state reached
    for step in (0, 5, 12):
        rest = [
            scene.stage_cost(np, path[t, :1, None], path[t, 1:, None], found.theta[t : t + 1, None])[0]
            for t in range(step, 12)
        ]
        rest.append(scene.terminal_cost(np, path[12, :1, None], path[12, 1:, None])[0])
        assert scene.cost_to_go(path[step, :1, None], path[step, 1:, None], step)[0] == pytest.approx(
            sum(rest), rel=CHECKED
        )


def test_two_balls():
    assert TwoBalls().optimum(Impulse(), None)[0] == pytest.approx(1.39654216, rel=1e-8)
    problem = bench.problem("two_balls", contact="impulse", backend="numpy")
    assert problem.value(np.zeros(240), np.zeros((240, 1)))[0] == pytest.approx(2.0)
    assert TwoBalls(effort=10.0).optimum(Impulse(), None)[0] == 2.0  # no blow is worth it
    assert TwoBalls().optimum(Penalty(), None) is None
    assert Lqr().optimum(None, ExplicitEuler()) is None


def test_classes_of_problems():
    def class_of(*words):
        made, (cell,) = loaded("study=optimise", "backends=[numpy]", "estimators=[fobg]", "optimizers=[adam]", *words)
        return scene_class(cell, RunSession(made).problem(cell))

    assert class_of("scenes=[spring_record[horizon=4]]") == "identification"
    assert class_of("scenes=[quadratic]", "theta=[condition]") == "identification"
    assert class_of("scenes=[quadratic]") == "smooth"
    assert class_of("scenes=[heaviside]") == "discontinuous"
    assert class_of("scenes=[bouncing_ball[horizon=4]]", "contacts=[penalty]") == "stiff"
    assert class_of("scenes=[bouncing_ball[horizon=4]]", "contacts=[impulse]") == "discontinuous"


def test_a_cost_without_lower_bound_has_no_optimum():
    found = solve(bench.problem("linear", backend="numpy"), steps=2)
    assert not found.certified
    assert found.cost == -math.inf


@pytest.mark.parametrize(
    ("start", "least", "saddle"),
    [((0.0, 0.0), -0.25, True), ((0.5, 0.0), -0.25, False), ((2**-0.5, 0.0), -0.25, False)],
)
def test_a_saddle_at_the_start_is_left_and_named(tmp_path, start, least, saddle):
    """x^4 - x^2 + y^2 has a saddle at 0 and minima of -1/4 at x = +-1/sqrt(2)."""
    file = tmp_path / "well.py"
    file.write_text(
        "def cost(p):\n    return p[0] ** 4 - p[0] ** 2 + p[1] ** 2\n"
        "def slope(p):\n    return [4 * p[0] ** 3 - 2 * p[0], 2 * p[1]]\n"
        f"theta = {list(start)}\n"
    )
    problem = bench.problem(f"callable[cost={file}:cost,grad=slope,sigma=0.1]", backend="callable")
    found = solve(problem)
    assert found.starts_at_saddle == saddle
    assert found.certified
    assert found.cost == pytest.approx(least, rel=1e-9)


# ------------------------------------------------------------------------------------------------------ a search

WORDS = [
    "name=small",
    "study=optimise[budget=600,gradient_cost=1]",
    "scenes=[quadratic]",
    "backends=[numpy]",
    "estimators=[fobg,reinforce]",
    "optimizers=[gradient_descent,cem[population=20,elites=5]]",
    "sweep.rate=[0.01,0.1]",
    "sweep.seed=[0,1]",
    "samples=8",
    "repeats=4",
    "workers=0",
]


BARE = ["name=none", "scenes=[quadratic]", "backends=[numpy]", "estimators=[fobg]", "optimizers=[adam]", "workers=0"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("optimise")
    assert main([*WORDS, f"results_dir={folder}"]) == 0
    return folder / "small", config.load([*WORDS, f"results_dir={folder}"])


def test_paths_end_at_the_budget_and_near_the_optimum(finished):
    rows = bench.load(finished[0])
    assert set(rows["stopped"]) == {"budget"}
    spent = rows["rollouts"] + rows["gradients"]
    assert ((spent >= 600) & (spent < 650 + 100)).all()
    good = rows[(rows["estimator"] == "fobg") & (rows["rate"] == 0.1)]
    assert (good["score"] > 0.99).all()
    assert (good["optimum"].abs() < 1e-12).all()
    for _, row in rows.iterrows():
        assert row["path_cost"][0] == row["start_cost"]
        assert row["path_cost"][-1] == row["final_cost"]
        assert list(row["path_rollouts"]) == sorted(row["path_rollouts"])


def measured(*words, folder):
    experiment, (cell,) = loaded(*BARE, *words, f"results_dir={folder}")
    return experiment.study.measure(cell, RunSession(experiment))


def test_tables_charts_and_page(finished):
    folder, experiment = finished
    for name in ("optimise.csv", "targets.csv", "runtimes.png", "answer.json", "targets.png", "report.html"):
        assert (folder / name).stat().st_size > 0, name
    made = (folder / "report.html").read_text().partition('id="made"')[2]
    assert "numpy" in made.partition("Configuration")[0], "machine and versions are in the page"
    found = studied.collect_runs(experiment, bench.load(folder))
    searches = found.rows.groupby("method").size().to_dict()
    # a search that looks at costs only is run once for all estimators
    assert searches == {"fobg, gradient_descent": 4, "reinforce, gradient_descent": 4, "cem[elites=5,population=20]": 2}
    assert found.best_tunings[found.rows["problem"].iloc[0], "fobg, gradient_descent"] == "rate=0.1"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["study=optimise", "optimizers=[gauss_newton]"], "gauss_newton needs jacobian and residual"),
        (["study=identify", "optimizers=[gauss_newton]"], "scene quadratic is a plain function"),
    ],
)
def test_an_experiment_of_which_nothing_can_run_is_bad_input(words, message, tmp_path, capsys):
    given = [word for word in BARE if word != "estimators=[fobg]" or "study=identify" not in words]
    assert main([*given, *words, f"results_dir={tmp_path}"]) == 2
    assert "no cell can be run: " in (said := capsys.readouterr().err)
    assert message in said
    assert not list(tmp_path.rglob("*.csv"))


@pytest.mark.parametrize(
    ("words", "stopped"),
    [
        (["study=optimise[quality=none]", "optimizers=[gradient_descent[rate=10]]"], "diverged"),
        (["study=optimise[quality=none,iterations=3]"], "budget"),
    ],
)
def test_what_ends_a_search(tmp_path, words, stopped):
    row = measured(*words, "samples=4", folder=tmp_path)
    assert row["stopped"] == stopped
    assert row["status"] == ("diverged" if stopped == "diverged" else "ok")
    # what is scored along the path is not paid for
    assert (row["rollouts"], row["gradients"]) == (0, 4 * row["iterations"])


def test_a_long_path_is_stored_with_its_start_its_lowest_cost_and_its_end():
    found = stored_indices([*np.ones(990), 0.0, *np.ones(9)])
    assert {0, 990, 999} <= set(found)
    assert len(found) <= 301


def test_a_bias_of_3_in_an_error_of_5_is_9_of_25_of_its_square(monkeypatch, tmp_path):
    found = {"bias": 3.0, "rmse": 5.0, "reason": "", "reference_method": "", "reference_spacing": math.nan}
    monkeypatch.setattr(measured_by, "against_reference", lambda *_: found)
    row = measured("study=optimise[iterations=1]", "samples=3", folder=tmp_path)
    assert row["quality_bias_share"] == pytest.approx(9 / 25)


# ---------------------------------------------------------------------------------------------------- statistics


def test_average_runtime_counts_failures():
    spent, reached = np.array([10.0, 100.0, 30.0]), np.array([True, False, True])
    assert performance.average_runtime(spent, reached) == 70.0
    assert math.isinf(performance.average_runtime(spent, np.zeros(3, dtype=bool)))
    low, high = performance.runtime_interval(spent, reached)
    assert low < 70.0 < high
    assert math.isinf(performance.runtime_interval(spent, np.array([True, False, False]))[1])  # a third of a third fail


def test_interquartile_mean_by_hand():
    assert performance.interquartile_mean(np.array([1.0, 2, 3, 4, 5, 6])) == pytest.approx(
        (2 * 0.5 + 3 + 4 + 5 * 0.5) / 3
    )
    assert performance.interquartile_mean(np.arange(8.0)) == pytest.approx(3.5)


def searches(finals):
    """One problem's searches: final costs by method and tuning, one for each seed."""
    rows = [
        {
            "problem": "p",
            "scene": "p",
            "method": method,
            "tuning": tuning,
            "seed": seed,
            "final_cost": cost,
            "status": "ok",
        }
        for (method, tuning), costs in finals.items()
        for seed, cost in enumerate(costs)
    ]
    return studied.RunSet(pd.DataFrame(rows))


def test_seeds_that_choose_a_tuning_do_not_score_it():
    """A tuning that is lucky on the scored seeds is not taken, and one that is lucky on its own is scored without them.

    One that diverges is never taken, whatever its last cost.
    """
    tunings = {("tuned", "0"): [0] * 5, ("tuned", "1"): [1, 1, 9, 9, 9], ("tuned", "2"): [2, 2, 0, 0, 0]}
    found = searches(tunings | {("plain", ""): [5, 5, 5, 5, 5]})
    found.rows.loc[found.rows["tuning"] == "0", "status"] = "diverged"
    assert found.tuning_seeds == (0, 1)
    assert found.best_tunings == {("p", "tuned"): "1", ("p", "plain"): ""}
    assert found.best_runs.groupby("method")["final_cost"].mean().to_dict() == {"tuned": 9, "plain": 5}
    assert sorted(found.best_runs["seed"].unique()) == [2, 3, 4]  # the same for all methods, so that pairs remain


@pytest.mark.parametrize("finals", [{("one", ""): [1, 2, 3, 4, 5]}, {("few", "1"): [1, 2, 3], ("few", "2"): [2, 3, 4]}])
def test_few_seeds_or_nothing_tuned_use_all_seeds(finals):
    found = searches(finals)
    assert found.tuning_seeds == ()
    assert len(found.best_runs) == len(next(iter(finals.values())))


def test_a_method_beats_the_baseline_in_the_share_of_pairs_that_it_wins():
    """Two wins, a tie and two losses are a half, with Wilson's interval of five pairs; a failed search has lost."""
    runs = searches({("fobg", ""): [3, 3, 3, 3, 3], ("other", ""): [1, 2, 3, 4, 5], ("failed", ""): [1, 1, 1, 1, 1]})
    runs.rows.loc[runs.rows["method"] == "failed", "status"] = "diverged"
    found = studied.improvement(runs)
    assert found.loc["other"].tolist() == pytest.approx([0.5, 0.1176208, 0.7692757], rel=1e-6)
    assert found["improvement"].isna().tolist() == [True, False, False]
    assert found.loc["failed", "improvement"] == 0.0


# ---------------------------------------------------------------------------------------------------- what is shown


def raced(rates, scenes):
    """Searches whose only target is reached by a share of ten seeds, by method and problem; a problem's scene is its name's start."""
    rows = [
        {
            "problem": f"{scene}[{i}]",
            "scene": f"{scene}[{i}]",
            "method": method,
            "tuning": "",
            "seed": seed,
            "status": "ok",
            "best_known": 0.0,
            "start_cost": 1.0,
            "final_cost": float(seed >= 10 * rate),
            "ratio": 1.0,
            "score": float(seed < 10 * rate),
            "path_rollouts": [0, 1],
            "path_gradients": [0, 0],
            "path_cost": [1.0, 1e-9 if seed < 10 * rate else 1.0],
        }
        for method, given in rates.items()
        for i, (scene, rate) in enumerate(zip(scenes, given, strict=True))
        for seed in range(10)
    ]
    return studied.RunSet(pd.DataFrame(rows))


SAME, APART = ["a", "a", "a", "a", "a", "b"], ["a", "b", "c", "d", "e", "f"]


@pytest.mark.parametrize(
    ("scenes", "lead", "tied"),
    [
        (APART, [0.6] * 6, False),
        (SAME, [0.6] * 6, False),
        (APART, [0.1] * 6, True),
        (APART, [0.9] * 5 + [0.2], False),
        (SAME, [0.9] * 5 + [0.2], True),
    ],
)
def test_a_lead_on_one_scenes_problems_is_one_observation(scenes, lead, tied):
    runs = raced({"first": [1.0] * 6, "second": [1.0 - x for x in lead]}, scenes)
    assert studied.first_or_tied(runs) == {"first"} | ({"second"} if tied else set())


def test_intervals_are_over_scenes():
    rates = [0.7, 0.7, 0.7, 0.3, 0.3, 0.3]
    wide = {}
    for name, scenes in (("few", ["a", "a", "a", "b", "b", "b"]), ("many", APART), ("one", ["a"] * 6)):
        (line,) = studied.summarise(raced({"only": rates}, scenes)).to_dict("records")
        assert line["reached"] == pytest.approx(0.5)
        wide[name] = line["reached_high"] - line["reached_low"]
        assert line["score_low"] <= line["score"] <= line["score_high"]
        if name == "few":
            # of one scene twice, with 70% or 30% of ones: the middle half has 90% or 10%
            assert [line["score_low"], line["score_high"]] == pytest.approx([0.1, 0.9])
    assert wide["few"] > wide["many"] > wide["one"]
    # deviations of 0.2 over six scenes, and Student's quantile with 5 degrees of freedom
    assert wide["many"] == pytest.approx(2 * 2.5706 * 0.2 / math.sqrt(5), rel=1e-4)
