"""The study of training: what it shows of made-up runs, what it refuses, and one small run of it all."""

import numpy as np
import pandas as pd
import pytest
from bench.plugins.studies.train import views as studied

import bench
from bench.errors import UserError
from bench.experiment import config
from bench.experiment.grid import cells
from bench.measure import performance
from bench.run.tasks import blank_row

BASE = ["study=train", "scenes=[cartpole_swing]", "integrators=[semi_implicit_euler]", "backends=[jax]", "samples=1"]
FINAL = {"shac": -530.0, "shac[window=8]": -700.0, "ppo": -900.0}


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    """Fewer resamples per interval; the made-up returns are further apart than these intervals are uncertain."""
    monkeypatch.setattr(performance, "RESAMPLES", 200)


def made_up(final=FINAL, seeds=range(5), spread=10.0, **columns):
    """Return an experiment and its rows: a curve of three evaluations per run, noise of ``spread`` between seeds."""
    experiment = config.load([*BASE, f"trainers={list(final)}", f"sweep.seed={list(seeds)}"])
    rows, rng = [], np.random.default_rng(0)
    for cell in cells(experiment):
        row = blank_row(experiment, cell)
        last = final[row["trainer"]] + spread * rng.standard_normal()
        curve = [-2000.0, -1200.0, last]
        window = getattr(cell.parts["trainer"], "window", np.nan)
        rows.append(
            row
            | {
                "status": "ok",
                "first_return": -2000.0,
                "final_return": last,
                "steps": 1e6,
                "updates": 500,
                "train_s": 30.0,
                "compile_s": 9.0,
                "gradient_typical": 1.0,
                "gradient_peak": 5.0,
                "curve_return": curve,
                "curve_return_low": curve,
                "curve_return_high": curve,
                "curve_step": [0, 5e5, 1e6],
                "curve_update": [0, 250, 500],
                "curve_s": [0.0, 15.0, 30.0],
                "window_gradient": 10.0,
                "window_bias": 10.0 / window,
                "window_bias_low": 9.0 / window,
                "window_bias_high": 11.0 / window,
                "log_update": [250, 500],
                "log_reward": [-8.0, -3.0],
                "log_gradient_norm": [1.0, 5.0],
                "cosine_update": [100, 300],
                "cosine": [0.9, 0.8],
            }
            | columns
        )
    return experiment, experiment.columns.typed(pd.DataFrame(rows))


def tables_of(experiment, rows):
    return {table.name: table for table in studied.views(experiment, rows).tables}


def verdicts_of(experiment, rows):
    """The verdict on each trainer, by the table of trainers."""
    return tables_of(experiment, rows)["summary"].frame.set_index("method")["verdict"].to_dict()


@pytest.mark.parametrize(
    ("given", "verdicts"),
    [
        ({}, ["first", "not chosen", "behind"]),
        # shac's other window would end below ppo: one setting of each would not tell
        ({"final": {**FINAL, "ppo": -600.0}}, ["open", "open", "not chosen"]),
        ({"final": {**FINAL, "ppo": -600.0, "bptt": -900.0}}, ["first", "open", "not chosen", "behind"]),
        ({"final": {"shac": -530.0, "ppo": -535.0}, "spread": 40.0}, ["open", "open"]),
        ({"seeds": range(4)}, ["open", "not chosen", "open"]),
    ],
)
def test_the_best_trainer_is_first_where_intervals_of_enough_seeds_are_apart(given, verdicts):
    assert list(verdicts_of(*made_up(**given)).values()) == verdicts


def test_a_setting_is_chosen_on_seeds_that_are_not_reported():
    """The longer window ends highest on the seeds that choose, and the shorter on the others."""
    experiment, rows = made_up({"shac": -530.0, "shac[window=8]": -560.0, "ppo": -900.0}, range(9), spread=1.0)
    rows.loc[(rows["trainer"] == "shac[window=8]") & (rows["seed"] >= 3), "final_return"] += 100.0
    summary = tables_of(experiment, rows)["summary"].frame.set_index("method")
    assert summary["verdict"].to_dict() == {"shac": "first", "shac[window=8]": "not chosen", "ppo": "behind"}
    assert set(summary["seeds"]) == {6}


@pytest.mark.parametrize(("count", "reported"), [(5, 5), (7, 7), (8, 5), (10, 6)])
def test_seeds_choose_only_where_enough_are_left_for_a_test(count, reported):
    """The chart of windows, which has all seeds, stated the number of the reported ones."""
    shown = studied.views(*made_up(seeds=range(count)))
    summary = shown.tables[1].frame
    assert set(summary["seeds"]) == {reported}
    assert summary["final_low"].notna().all()
    for chart in shown.charts:
        assert f" over {count if chart.name == 'windows' else reported} seeds" in chart.subtitle


@pytest.mark.parametrize(("own", "verdict"), [(-500.0, "not chosen"), (-300.0, "not run")])
def test_a_setting_with_only_the_seeds_that_choose_counts_as_tried(own, verdict):
    experiment, rows = made_up({"shac": -400.0, "shac[window=8]": own, "ppo": -900.0}, range(9), spread=1.0)
    rows = rows[(rows["trainer"] != "shac[window=8]") | (rows["seed"] < 3)]
    summary = tables_of(experiment, rows)["summary"].frame.set_index("method")
    assert summary.loc["shac[window=8]", "verdict"] == verdict
    assert summary.loc["shac", "settings"] == 2
    assert np.isnan(summary.loc["shac[window=8]", "final"])
    assert summary.loc["shac[window=8]", "tuned"] == pytest.approx(own, abs=3.0)


@pytest.mark.parametrize(("own", "lacking", "lost"), [(-500.0, [0, 1, 2], 0.0), (-410.0, [2, 3], 300.0)])
def test_settings_are_chosen_on_the_seeds_that_all_of_them_have(own, lacking, lost):
    """The longer window lacks all seeds that choose, or some on which the shorter one ends lower."""
    experiment, rows = made_up({"shac": -400.0, "shac[window=8]": own, "ppo": -900.0}, range(10), spread=1.0)
    unshared = rows["seed"].isin(lacking)
    rows.loc[(rows["trainer"] == "shac") & unshared, "final_return"] -= lost
    rows = rows[(rows["trainer"] != "shac[window=8]") | ~unshared]
    assert verdicts_of(experiment, rows) == {"shac": "first", "shac[window=8]": "not chosen", "ppo": "behind"}


def test_few_seeds_give_no_interval_and_no_order():
    experiment, rows = made_up(seeds=range(4))
    shown = studied.views(experiment, rows)
    frames = {table.name: table.frame for table in shown.tables}
    for frame in (frames["summary"], frames["windows"], next(c.frame for c in shown.charts if c.name == "train")):
        ends = frame.filter(regex="^(final|cost)_(low|high)$")
        assert ends.shape[1] == 2
        assert ends.isna().all().all()


def test_windows_that_are_not_distinguishable_from_the_best_are_tied():
    windows = tables_of(*made_up({"shac": -530.0, "shac[window=16]": -531.0, "shac[window=8]": -700.0}))[
        "windows"
    ].frame
    assert sorted(windows["verdict"]) == ["behind", "first", "tied"]
    assert windows.loc[windows["verdict"] == "behind", "window"].tolist() == [8]


@pytest.mark.slow
def test_a_trainer_without_a_run_that_ends_is_not_the_best_by_its_untrained_policy():
    experiment, rows = made_up()
    planted = rows["trainer"] == "ppo"
    rows.loc[planted, ["status", "first_return"]] = ["nonfinite", -100.0]
    assert verdicts_of(experiment, rows) == {"shac": "first", "shac[window=8]": "not chosen", "ppo": "no result"}
    rows.loc[rows["trainer"] == "shac[window=8]", ["status", "first_return"]] = ["nonfinite", -100.0]
    assert "windows" not in tables_of(experiment, rows), "one window is left"
    rows["status"] = "nonfinite"
    assert set(verdicts_of(experiment, rows).values()) == {"no result"}


def test_a_run_that_is_not_finite_counts_as_its_untrained_policy():
    experiment, rows = made_up({"shac": -530.0})
    rows.loc[0, ["status", "final_return"]] = ["nonfinite", -100.0]
    rows.at[0, "curve_return"], rows.at[0, "curve_step"] = [-2000.0, np.nan], [0, 5e5]
    runs = studied.runs_of(experiment, rows)
    assert studied.final_returns(runs)[0] == -2000.0
    assert np.isfinite(studied.curves_of(runs)[["time", "cost"]]).all(axis=None)
    assert studied.summarise(runs)["failed"].tolist() == [1]


def test_a_fault_is_reported_with_its_run_and_its_number():
    table = tables_of(*made_up(gradient_zero=0.9))["faults"]
    assert len(table.frame) == 15
    assert (table.frame[["code", "value"]] == ["zero", 0.9]).all(axis=None)
    assert "- zero: share of updates with a gradient of exactly 0" in table.notes


def test_returns_at_equal_used_steps_are_those_of_the_last_evaluation_within_them():
    """A run that uses a tenth of its steps at first, and half of them later, sets the limit for the others."""
    experiment, rows = made_up({"shac": -530.0, "evolution": -600.0})
    for i in rows.index[rows["trainer"] == "evolution"]:
        rows.at[i, "log_used"] = [0.1, 0.5]
    runs = studied.runs_of(experiment, rows)
    summary = studied.summarise(runs).set_index("method")
    assert summary["used"].to_dict() == {"shac": 1e6, "evolution": 3e5}
    assert summary.loc["evolution", "equal"] == summary.loc["evolution", "final"]
    assert summary.loc["shac", "equal"] == runs["curve_return"].iloc[0][0]


def test_a_return_above_another_by_less_than_noise_is_not_behind():
    best = np.array([-8.0, -7.0, -9.0, -8.5, -7.5])
    lines = pd.DataFrame({"final": [-9.0, -8.0], "returns": [best - 0.6, best], "group": "one", "family": ["a", "b"]})
    lines = lines.assign(failed=0, seeds=5, tuned=0.0)
    assert studied.ranked(lines, ["group"])["verdict"].tolist() == ["open", "open"]
    # the intervals of a few seeds may overlap where a test of the difference finds one
    found = studied.ranked(lines.assign(returns=[best - 1.9, best]), ["group"])
    assert found["verdict"].tolist() == ["behind", "first"]
    assert found["behind"][0] == pytest.approx(1.9)
    assert found["behind_low"][0] < 1.9 < found["behind_high"][0]
    # the test alone would find one here, of p = 0.03
    wide = [np.array([50.0, 55.0, 57.0, 59.0, 235.0]), np.array([60.0, 70.0, 300.0, 400.0, 440.0])]
    assert studied.ranked(lines.assign(returns=wide), ["group"])["verdict"].tolist() == ["open", "open"]


@pytest.mark.parametrize(
    ("scene", "backend", "message"),
    [
        ("pendulum", "jax", "scene pendulum has no observations, from which a policy acts"),
        ("cartpole_swing", "numpy", "backend numpy does not run programs in JAX"),
    ],
)
def test_a_cell_without_a_policy_in_jax_is_refused_with_the_reason(tmp_path, scene, backend, message):
    with pytest.raises(UserError, match=message):
        bench.run(study="train", results_dir=tmp_path, scenes=[scene], backends=[backend], trainers=["shac"])


@pytest.mark.slow
def test_a_run_of_the_quick_experiment_has_a_log_and_comparisons_of_gradients(tmp_path):
    words = {"trainers": ["shac[window=8]"], "sweep": {"seed": [0]}, "workers": 0, "timing": False}
    (row,) = bench.run("train/quick", results_dir=tmp_path, **words).to_dict("records")
    assert row["status"] == "ok"
    assert np.isfinite(row["final_return"])
    assert max(row["slope_errors"]) < 1e-4
    assert len(row["cosine"]) == 3
    assert len(row["log_gradient_norm"]) > 0
