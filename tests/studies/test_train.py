"""The study of training: what it shows of made-up runs, what it refuses, and one small run of it all."""

import json
import re

import numpy as np
import pandas as pd
import pytest

import bench
from bench.errors import UserError
from bench.experiment import config
from bench.experiment.grid import cells
from bench.run.tasks import blank_row
from bench.studies.train import aggregate, findings
from bench.studies.train.views import views

BASE = ["study=train", "scenes=[cartpole_swing]", "integrators=[semi_implicit_euler]", "backends=[jax]", "samples=1"]
FINAL = {"shac": -530.0, "shac[window=8]": -700.0, "ppo": -900.0}


def made_up(final=FINAL, seeds=range(5), spread=10.0, **columns):
    """Return an experiment and its rows: a curve of three evaluations per run, noise of ``spread`` between seeds."""
    names = ",".join(f'"{name}"' for name in final)
    experiment = config.load([*BASE, f"trainers=[{names}]", f"sweep.seed={list(seeds)}"])
    rows, rng = [], np.random.default_rng(0)
    for cell in cells(experiment):
        row = blank_row(experiment, cell)
        last = final[row["trainer"]] + spread * rng.standard_normal()
        curve = [-2000.0, -1200.0, last]
        window = getattr(cell.parts["trainer"], "window", np.nan)
        rows.append(row | {
            "status": "ok", "first_return": -2000.0, "final_return": last, "steps": 1e6, "updates": 500, "train_s": 30.0,
            "compile_s": 9.0, "gradient_typical": 1.0, "gradient_peak": 5.0, "verdicts": "[]", "curve_return": curve,
            "curve_step": [0, 5e5, 1e6], "curve_update": [0, 250, 500], "curve_s": [0.0, 15.0, 30.0],
            "window_gradient": 10.0, "window_bias": 10.0 / window, "window_bias_low": 9.0 / window, "window_bias_high": 11.0 / window,
            "log_update": [250, 500], "log_reward": [-8.0, -3.0], "log_gradient_norm": [1.0, 5.0],
            "cosine_update": [100, 300], "cosine": [0.9, 0.8],
        } | columns)  # fmt: skip
    return experiment, experiment.columns.typed(pd.DataFrame(rows))


def test_the_best_trainer_is_named_with_its_interval_and_those_behind_it():
    experiment, rows = made_up()
    first, second, third = views(experiment, rows).findings
    assert first.startswith("The best final return is -5")
    assert "(shac), and shac[window=8] and ppo end lower" in first
    assert second == "Among windows of shac, 32 steps end best, and 8 steps end lower."
    assert third == "The logs of 15 runs show no fault."
    assert all(text.endswith(".") and ";" not in text for text in (first, second, third))


def test_trainers_whose_intervals_overlap_are_open():
    experiment, rows = made_up({"shac": -530.0, "ppo": -535.0}, spread=40.0)
    assert views(experiment, rows).findings[0].startswith("Which trainer is best is open: ")


def test_few_seeds_give_no_interval_and_no_order():
    experiment, rows = made_up(seeds=range(4))
    shown = views(experiment, rows)
    assert re.fullmatch(
        r"Which trainer is best is open, since 4 seeds are too few for an interval: the highest final return is -5\d\d \(shac\)\.",
        shown.findings[0],
    )
    texts = [*(chart.subtitle for chart in shown.charts), *(note for table in shown.tables for note in table.notes)]
    told = [text for text in texts if "interquartile" in text]
    assert len(told) == 5, "the curves, the windows, and the notes of two tables"
    assert all("interquartile mean over 4 seeds, too few for an interval" in text for text in told)


def test_windows_that_are_not_distinguishable_from_the_best_are_named():
    experiment, rows = made_up({"shac": -530.0, "shac[window=16]": -531.0, "shac[window=8]": -700.0})
    assert views(experiment, rows).findings[1] in {
        f"Among windows of shac, {best} steps end best, not distinguishable from {other} steps, and 8 steps end lower."
        for best, other in ((16, 32), (32, 16))
    }


def test_titles_over_several_problems_count_them_instead_of_naming_the_first():
    runs = []
    for k, final in (("1e3", FINAL), ("1e4", dict.fromkeys(FINAL, -600.0))):
        experiment, rows = made_up(final, spread=10.0 if k == "1e3" else 100.0)
        runs.append(aggregate.runs_of(experiment, rows).assign(problem=f"stiffness={k}"))
    every = pd.concat(runs, ignore_index=True)
    summary, windows = aggregate.summarise(every), aggregate.windows(every)
    assert findings.title(summary) == "Trainers end lower than the best on 1 of 2 problems"
    assert findings.window_title(windows) == "Among windows of shac, 32 steps end best on 1 of 2 problems"
    last = windows[windows["problem"] == "stiffness=1e4"]
    assert findings.window_title(pd.concat([last, last.assign(problem="other")])) == (
        "Among windows of shac, which length ends best is open"
    )


def test_lengths_of_windows_are_compared_by_their_returns_and_a_bias_is_named_only_where_its_interval_excludes_0():
    experiment, rows = made_up()
    rows.loc[rows["trainer"] == "shac[window=8]", "window_bias_low"] = 0.0
    shown = views(experiment, rows)
    chart = next(chart for chart in shown.charts if chart.name == "windows")
    assert [column.name for column in chart.y] == ["final", "window_bias", "window_gradient"]
    assert "bias" not in " ".join(shown.findings)
    lines = next(table for table in shown.tables if table.name == "windows").frame.set_index("window")
    assert lines.loc[8, "bias"] == "not distinguishable from 0 (up to 1.4)"
    assert lines.loc[32, "bias"] == "0.31 [0.28, 0.34]"


def test_a_trainer_without_a_run_that_ends_is_not_the_best_by_its_untrained_policy():
    experiment, rows = made_up()
    planted = rows["trainer"] == "ppo"
    rows.loc[planted, ["status", "first_return"]] = ["nonfinite", -100.0]
    text = views(experiment, rows).findings[0]
    assert "(shac), and shac[window=8] ends lower" in text
    assert text.endswith(", and no run of ppo ends with a finite return.")
    assert "-100" not in text
    rows.loc[rows["trainer"] == "shac[window=8]", ["status", "first_return"]] = ["nonfinite", -100.0]
    assert not any("windows" in found for found in views(experiment, rows).findings), "one window is left"
    rows["status"] = "nonfinite"
    assert views(experiment, rows).findings[0] == "No run ends with a finite return."


def test_runs_that_are_not_finite_are_named_beside_a_final_return():
    experiment, rows = made_up({"shac": -530.0})
    rows.loc[0, "status"] = "nonfinite"
    assert views(experiment, rows).findings[0].endswith(", 1 of 5 runs not finite.")


def test_a_run_that_is_not_finite_counts_as_its_untrained_policy():
    experiment, rows = made_up({"shac": -530.0})
    rows.loc[0, ["status", "final_return"]] = ["nonfinite", -100.0]
    rows.at[0, "curve_return"] = [-2000.0, np.nan]
    runs = aggregate.runs_of(experiment, rows)
    assert aggregate.final_returns(runs)[0] == -2000.0
    assert np.isfinite(aggregate.curves(runs)["cost"]).all()
    assert aggregate.summarise(runs)["failed"].tolist() == [1]


def test_a_fault_is_reported_in_words_with_its_run():
    experiment, rows = made_up(verdicts=json.dumps([{"code": "not_finite", "update": 7, "quantity": "loss"}]))
    shown = views(experiment, rows)
    assert shown.findings[2] == (
        "The logs of 15 of 15 runs show a fault, most often this: NaN at update 7: the loss is not finite (shac, seed 0)."
    )
    table = next(table for table in shown.tables if table.name == "faults")
    assert set(table.frame["words"]) == {"NaN at update 7: the loss is not finite"}


@pytest.mark.parametrize(("cosine_update", "count"), [([100, 300], 15), ([], 0)])
def test_a_cut_gradient_is_a_fault_only_of_trainers_that_differentiate_the_simulation(cosine_update, count):
    assert len(planted(FINAL, {"code": "cut", "share": 1.0}, cosine_update=cosine_update)) == count


@pytest.mark.parametrize(("trainer", "count"), [("shac", 5), ("shac[window=240]", 0), ("bptt", 0)])
def test_a_cut_gradient_is_no_fault_of_whole_episodes_which_are_cut_by_construction(trainer, count):
    assert len(planted({trainer: -530.0}, {"code": "cut", "share": 1.0})) == count


@pytest.mark.parametrize(("contacts", "is_told"), [([2.0, 1.0], False), ([0.0, 1.0], True)])
def test_that_peaks_have_contact_is_told_only_where_some_updates_have_none(contacts, is_told):
    fault = {"code": "explodes", "update": 9, "factor": 200.0, "peaks": 2, "with_contact": 2}
    words = findings.describe(planted({"shac": -530.0}, fault, log_contacts=contacts)["fault"].iloc[0])
    assert ("peaks in updates with contact" in words) == is_told


def test_differences_that_do_not_agree_are_open_and_no_fault():
    fault = json.dumps([{"code": "differences", "error": 0.5}])
    experiment, rows = made_up({"shac": -530.0}, verdicts=fault)
    assert views(experiment, rows).findings[-1] == (
        "The logs of 5 runs show no fault, and in 5 central differences do not agree with the gradient, which is open."
    )


def planted(final, fault, **columns):
    """Return the faults of made-up runs that all have one."""
    experiment, rows = made_up(final, verdicts=json.dumps([fault]), difference_error=np.nan, **columns)
    return aggregate.faults(aggregate.runs_of(experiment, rows))


def test_the_chart_of_logs_has_one_axis_of_steps_for_all_quantities():
    experiment, rows = made_up()
    chart = next(chart for chart in views(experiment, rows).charts if chart.name == "train_log")
    assert set(chart.frame["quantity"]) == {"reward per step", "log10 of the gradient norm", "cosine with zeroth order"}
    assert chart.across == 1
    assert chart.frame["step"].max() == 1e6


def test_a_return_above_another_by_less_than_noise_is_not_below():
    low, high = {"final_low": -10.0, "final_high": -8.0}, {"final_low": -8.5, "final_high": -7.0}
    assert not findings.is_below(low, high)
    assert findings.is_below({**low, "final_high": -9.0}, high)


def test_rows_without_a_run_show_their_reasons():
    experiment, rows = made_up(status="error", reason="planted", curve_return=[])
    shown = views(experiment, rows)
    assert shown.findings == ["No run gave a result: the table has the reason of each."]
    assert shown.remarks == ["planted"]


def test_a_scene_without_observations_is_refused_with_the_reason(tmp_path):
    with pytest.raises(UserError, match="scene pendulum has no observations, from which a policy acts"):
        bench.run(study="train", results_dir=tmp_path, scenes=["pendulum"], backends=["jax"], trainers=["shac"])


def test_a_backend_without_jax_is_refused_with_the_reason(tmp_path):
    with pytest.raises(UserError, match="backend numpy does not run programs in JAX"):
        bench.run(study="train", results_dir=tmp_path, scenes=["cartpole_swing"], backends=["numpy"], trainers=["shac"])


def test_an_unknown_trainer_names_the_nearest_one():
    with pytest.raises(UserError, match="unknown trainer 'shack'; did you mean 'shac'"):
        config.load([*BASE, "trainers=[shack]"])


@pytest.mark.slow
def test_the_quick_experiment_runs_and_its_report_is_written(tmp_path):
    """Two windows and a search, with logs, comparisons of gradients, and finite returns that repeat."""
    overrides = {"results_dir": tmp_path, "workers": 0, "timing": False}
    rows = bench.run("train/quick", **overrides)
    assert (rows["status"] == "ok").all()
    assert np.isfinite(rows["final_return"]).all()
    shac = rows[rows["trainer"].str.startswith("shac")]
    assert (shac["difference_error"] < 0.1).all()
    assert all(len(values) == 3 for values in shac["cosine"])
    assert (rows["log_gradient_norm"].map(len) > 0).all()
