"""The study of training: what it shows of made-up runs, what it refuses, and one small run of it all."""

import json

import numpy as np
import pandas as pd
import pytest
from helpers import approve_views

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


OPEN_DIFFERENCES = json.dumps([{"code": "differences", "error": 0.5}])
NOT_FINITE = json.dumps([{"code": "not_finite", "update": 7, "quantity": "loss"}])


def with_lost(**lost):
    """Return made-up runs of which those of some trainers are not finite, and start from a better policy than others end with."""
    experiment, rows = made_up()
    for trainer, count in lost.items():
        places = rows.index[rows["trainer"] == trainer][:count]
        rows.loc[places, ["status", "first_return"]] = ["nonfinite", -100.0]
    return experiment, rows


CASES = {
    "three trainers": lambda: made_up(),
    "intervals that overlap": lambda: made_up({"shac": -530.0, "ppo": -535.0}, spread=40.0),
    "four seeds": lambda: made_up(seeds=range(4)),
    "two windows that are tied": lambda: made_up({"shac": -530.0, "shac[window=16]": -531.0, "shac[window=8]": -700.0}),
    "no finite run of one trainer": lambda: with_lost(ppo=5),
    "no finite run of any trainer": lambda: with_lost(**{"shac": 5, "shac[window=8]": 5, "ppo": 5}),
    "one run lost": lambda: with_lost(shac=1),
    "a fault in every run": lambda: made_up(verdicts=NOT_FINITE),
    "differences that do not agree": lambda: made_up({"shac": -530.0}, verdicts=OPEN_DIFFERENCES),
    "no result": lambda: made_up(status="error", reason="planted", curve_return=[]),
}


@pytest.mark.parametrize("case", CASES)
def test_findings_and_titles_of_made_up_runs(case):
    approve_views("train", case, views(*CASES[case]()))


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


def test_a_run_that_is_not_finite_counts_as_its_untrained_policy():
    experiment, rows = made_up({"shac": -530.0})
    rows.loc[0, ["status", "final_return"]] = ["nonfinite", -100.0]
    rows.at[0, "curve_return"] = [-2000.0, np.nan]
    runs = aggregate.runs_of(experiment, rows)
    assert aggregate.final_returns(runs)[0] == -2000.0
    assert np.isfinite(aggregate.curves(runs)["cost"]).all()
    assert aggregate.summarise(runs)["failed"].tolist() == [1]


def test_a_fault_is_reported_in_words_with_its_run():
    experiment, rows = made_up(verdicts=NOT_FINITE)
    shown = views(experiment, rows)
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
