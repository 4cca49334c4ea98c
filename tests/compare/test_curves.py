"""Learning curves of any origin: scores by hand, statistics by other code, bad tables, and files."""

import math

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import bench
from bench.__main__ import main

STEPS = (0, 50, 100)


def curves(ends: dict, steps=STEPS, axis="step") -> pd.DataFrame:
    """Return straight curves from 0 to each run's end: ``{(task, method): ends}``."""
    lines = [
        (task, method, seed, step, end * step / steps[-1])
        for (task, method), values in ends.items()
        for seed, end in enumerate(values)
        for step in steps
    ]
    return pd.DataFrame(lines, columns=["task", "method", "seed", axis, "return"])


def bounded(table: pd.DataFrame, low=0.0, high=1.0) -> pd.DataFrame:
    return table.assign(low=low, high=high)


def test_statistics_agree_with_other_code():
    a, b = np.array([0.1, 0.3, 0.2, 0.9, 0.5]), np.array([0.4, 1.2, 0.6, 0.3, 0.8])
    result = bench.aggregate(bounded(curves({("one", "m"): a, ("two", "m"): b})))
    line, pooled = result.table.iloc[0], np.concatenate([a, b])
    ordered = np.sort(pooled)
    assert line["iqm"] == pytest.approx((ordered[2] / 2 + ordered[3:7].sum() + ordered[7] / 2) / 5)
    assert line["iqm_rliable"] == pytest.approx(stats.trim_mean(pooled, 0.25))
    assert line["median"] == pytest.approx(np.median([a.mean(), b.mean()]))
    assert line["mean"] == pytest.approx(pooled.mean())
    assert line["gap"] == pytest.approx(np.maximum(1 - pooled, 0).mean())
    assert line["iqm_low"] < line["iqm"] < line["iqm_high"]
    profile = result.profile.set_index("score")["above"]
    assert profile[0.5] == pytest.approx((pooled > 0.5).mean())
    assert result.curves["share"].iloc[-1] == 1.0
    assert result.curves["iqm"].iloc[-1] == pytest.approx(line["iqm"])
    assert result.curves["iqm"].iloc[0] == 0.0
    ends = ["iqm_low", "iqm_high"]  # one number has one interval
    assert result.curves[ends].iloc[-1].tolist() == line[ends].tolist()


@pytest.mark.slow
def test_interval_of_the_interquartile_mean_holds_the_truth():
    held = []
    for seed in range(60):
        random = np.random.default_rng(seed)
        ends = {(task, "m"): 0.5 + 0.1 * random.standard_normal(10) for task in ("one", "two", "three")}
        line = bench.aggregate(bounded(curves(ends, (0, 1)))).table.iloc[0]
        held.append(line["iqm_low"] <= 0.5 <= line["iqm_high"])
    assert stats.binomtest(sum(held), len(held), 0.95, alternative="less").pvalue > 0.01


def test_a_method_is_ahead_where_the_interval_says_so():
    random = np.random.default_rng(0)
    finding = bench.aggregate(
        curves({("t", "far"): random.normal(0, 0.1, 8), ("t", "near"): random.normal(1, 0.1, 8)})
    ).finding
    assert finding.startswith("near has the highest")
    assert "distinguishable" not in finding


def test_equal_methods_are_not_distinguishable():
    random = np.random.default_rng(1)
    finding = bench.aggregate(curves({("t", name): random.normal(1, 0.3, 8) for name in "ab"})).finding
    assert "not distinguishable from" in finding


@pytest.mark.parametrize("runs", [1, 2])
def test_few_runs_leave_it_open(runs):
    result = bench.aggregate(curves({("t", "a"): [1.0] * runs, ("t", "b"): [9.0] * runs}))
    assert result.finding.startswith("Open")
    assert "too narrow" in result.remarks[0]


def test_lower_is_better_where_asked():
    table = curves({("t", "a"): [3.0, 4.0, 5.0], ("t", "b"): [7.0, 8.0, 9.0]})
    up = bench.aggregate(table.assign(**{"return": -table["return"]})).table
    down = bench.aggregate(table, better="lower").table
    pd.testing.assert_frame_equal(up, down)
    assert down["method"].tolist() == ["a", "b"]
    given = bench.aggregate(table.assign(low=10.0, high=0.0), better="lower").table
    assert given.loc[0, "mean"] == pytest.approx(0.6)


def test_the_budget_is_the_shortest_run_and_a_failed_run_scores_zero():
    short = curves({("t", "a"): [1.0, 1.0, 1.0]}, (0, 50))
    long = curves({("t", "b"): [1.0, 1.0, 1.0]}, (0, 50, 100, 150))
    result = bench.aggregate(bounded(pd.concat([short, long]))).table.set_index("method")
    assert result.loc["a", "mean"] == pytest.approx(1.0)
    assert result.loc["b", "mean"] == pytest.approx(1 / 3)
    failed = bounded(curves({("t", "a"): [1.0, math.nan, math.inf, 1.0]}))
    line = bench.aggregate(failed).table.iloc[0]
    assert (line["failed"], line["mean"]) == (2, 0.5)


def test_episodes_at_one_step_are_averaged_and_the_order_of_lines_is_free():
    table = bounded(curves({("t", "a"): [0.2, 0.4, 0.6]}))
    double = pd.concat(
        [table.assign(**{"return": 0.5 * table["return"]}), table.assign(**{"return": 1.5 * table["return"]})]
    )
    shuffled = double.sample(frac=1, random_state=0)
    pd.testing.assert_frame_equal(bench.aggregate(table).table, bench.aggregate(shuffled).table)


def test_tasks_without_every_method_are_left_out():
    ends = {("both", "a"): [1, 2, 3], ("both", "b"): [2, 3, 4], ("half", "a"): [1, 2, 3]}
    result = bench.aggregate(curves(ends))
    assert result.tasks == ["both"]
    assert "half" in result.remarks[0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.drop(columns="return"), ["no column 'return'"]),
        (lambda t: t.rename(columns={"return": "returns"}), ["rename 'returns'"]),
        (lambda t: t.drop(columns="step"), ["no column 'step'"]),
        (lambda t: t.assign(step=-1.0), ["step", "negative"]),
        (lambda t: t.assign(**{"return": "x"}), ["'x'", "not a number"]),
        (lambda t: t.assign(low=0.0), ["low", "high"]),
        (lambda t: t.assign(low=1.0, high=0.0), ["high"]),
        (lambda t: t.assign(low=t["step"], high=1e6), ["several values"]),
        (lambda t: t.iloc[:0], ["no lines"]),
        (lambda t: t.assign(task=None), ["task", "missing"]),
        (lambda t: t.assign(task=t["method"]), ["no task"]),
    ],
)  # fmt: skip
def test_bad_tables_are_named(change, words):
    table = curves({("t", "a"): [1, 2, 3], ("t", "b"): [1, 2, 3]})
    with pytest.raises(bench.UserError) as error:
        bench.aggregate(change(table))
    assert all(word in str(error.value) for word in words)


def test_command_writes_table_and_charts(tmp_path, capsys):
    file = tmp_path / "curves.csv"
    curves({("t", "a"): [1.0, 2.0, 3.0], ("t", "b"): [7.0, 8.0, 9.0]}, axis="seconds").to_csv(file, index=False)
    assert main(["aggregate", str(file), f"out={tmp_path / 'out'}"]) == 0
    assert "b has the highest interquartile mean" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "aggregate.csv", "aggregate.md", "curves.png", "curves.plotted.csv", "profile.png", "profile.plotted.csv",
    }  # fmt: skip
    assert main(["aggregate", str(tmp_path / "none.csv")]) == 2
    assert "none.csv" in capsys.readouterr().err
