"""Comparing two results: planted changes are found, chance is not, and what cannot be compared is said."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pandas as pd
import pytest
from test_report import small_rows

from bench import cli
from bench.report import compare, tables
from bench.report.compare import changes
from bench.store import BIAS_VARIANCE

MACHINE = {"processor": "a chip", "cores": 2, "system": "Linux", "load_average": [0.1, 0.1, 0.1]}


def given(calls=20, seed=1):
    """Rows with times of single calls, spread by 5%."""
    rows = small_rows(backends=("jax",), estimators=("fobg", "reinforce"))
    generator = np.random.default_rng(seed)
    rows["time_samples"] = [time * (1 + 0.05 * generator.standard_normal(calls)) for time in rows["time_s"]]
    rows["time_s"] = [float(np.median(samples)) for samples in rows["time_samples"]]
    return rows


def save(rows, directory, name="made_up", machine=MACHINE, parquet=True):
    """Rows as an experiment's directory."""
    place = directory / name
    place.mkdir(parents=True, exist_ok=True)
    if parquet:
        BIAS_VARIANCE.typed(rows).to_parquet(place / "rows.parquet", index=False)
    tables.write(rows, place)
    (place / "run.json").write_text(json.dumps({"machine": machine}))
    return directory


def run(*words, out):
    return cli.main(["compare", *map(str, words), f"out={out}"])


def only(found, outcome):
    """The one change among the cells."""
    changed = found[found["outcome"] != "same"]
    assert list(changed["outcome"]) == [outcome]
    return changed["change"].iloc[0]


def good(rows):
    return rows.index[rows["status"] == "ok"][0]


def test_errors_without_noise_are_judged_beyond_rounding():
    before = given().assign(model_error_rel=1e-13, program_error_rel=0.1)
    place = good(before)
    for name, value, expected in (
        ("model_error_rel", 5e-13, None),
        ("model_error_rel", 0.2, "worse"),
        ("program_error_rel", 0.11, None),
        ("program_error_rel", 0.01, "better"),
    ):
        after = before.copy()
        after.loc[place, name] = value
        found = changes.compared(before, after, timings=False)
        assert set(found["outcome"]) - {"same"} == ({expected} if expected else set())


def test_growth_rates_that_are_apart_are_changed():
    before = given().assign(stretch_rate=1.0, stretch_low=0.9, stretch_high=1.1)
    after = before.copy()
    after.loc[good(before), ["stretch_rate", "stretch_low", "stretch_high"]] = [2.0, 1.8, 2.2]
    assert "growth rate" in only(changes.compared(before, after, timings=False), "changed")


def test_equal_results_are_the_same_whatever_the_noise_of_their_times():
    found = changes.compared(given(seed=1), given(seed=2), timings=True)
    assert set(found["outcome"]) == {"same"}


@pytest.mark.parametrize(("factor", "outcome"), [(10.0, "worse"), (0.1, "better")])
@pytest.mark.parametrize("column", ["bias", "variance"])
def test_accuracy_beyond_the_intervals_is_a_change(factor, outcome, column):
    rows = given()
    place = good(rows)
    rows.loc[place, [column, f"{column}_low", f"{column}_high"]] = [2.0, 1.8, 2.2]
    after = rows.copy()
    after.loc[place, [column, f"{column}_low", f"{column}_high"]] *= factor
    assert only(changes.compared(rows, after, timings=False), outcome).startswith(column)
    after.loc[place, "reason"] = "heavy tails"
    assert "doubtful" in only(changes.compared(rows, after, timings=False), "changed")


def test_accuracy_within_the_intervals_is_none():
    rows = given()
    place = good(rows)
    rows.loc[place, ["bias", "bias_low", "bias_high"]] = [2.0, 1.8, 2.2]
    after = rows.copy()
    after.loc[place, ["bias", "bias_low", "bias_high"]] = [2.3, 2.1, 2.5]
    assert set(changes.compared(rows, after, timings=False)["outcome"]) == {"same"}


def test_variances_without_intervals_are_held_to_an_f_test():
    """Of equal variances at most 1% are told as changed; fourfold ones of 64 repeats always are."""
    generator = np.random.default_rng(0)
    equal = generator.chisquare(63, (2000, 2)) / 63
    assert np.mean([changes._outside_f(a / b, 64, 64) for a, b in equal]) < 0.015
    assert np.mean([changes._outside_f(4 * a / b, 64, 64) for a, b in equal]) > 0.99


@pytest.mark.parametrize(("factor", "outcome"), [(2.0, "worse"), (0.5, "better")])
@pytest.mark.parametrize("calls", [5, 64])
def test_a_time_that_differs_by_more_than_its_spread_is_a_change(factor, outcome, calls):
    before, after = given(calls), given(calls, seed=2)
    place = good(after)
    after.at[place, "time_samples"] = factor * after.at[place, "time_samples"]
    after.loc[place, "time_s"] *= factor
    assert only(changes.compared(before, after, timings=True), outcome).startswith("time")
    assert set(changes.compared(before, after, timings=False)["outcome"]) == {"same"}


def test_a_time_that_differs_by_less_than_the_least_effect_is_none_however_sure():
    before, after = given(200), given(200)
    after["time_samples"] = [1.2 * samples for samples in after["time_samples"]]
    after["time_s"] *= 1.2
    assert set(changes.compared(before, after, timings=True)["outcome"]) == {"same"}


def test_times_without_single_calls_are_judged_by_their_interquartile_range():
    before = given().drop(columns="time_samples")
    after = before.copy()
    place = good(after)
    before["time_iqr_s"] = after["time_iqr_s"] = 0.1 * before["time_s"]
    after.loc[place, "time_s"] *= 2
    assert only(changes.compared(before, after, timings=True), "worse").startswith("time")
    after["time_iqr_s"] = np.nan
    found = changes.compared(before, after, timings=True)
    assert set(found["outcome"]) == {"same"}
    assert found["time_judged_by"].str.startswith("not compared").any()


@pytest.mark.parametrize(("was", "now", "outcome"), [("ok", "error", "worse"), ("timeout", "ok", "better"), ("error", "crashed", "changed")])  # fmt: skip
def test_a_status_that_changed_is_told(was, now, outcome):
    before, after = given(), given()
    place = good(before)
    before.loc[place, "status"], after.loc[place, "status"] = was, now
    assert f"{was} to {now}" in only(changes.compared(before, after, timings=True), outcome)


def test_cells_that_are_gone_or_new_are_told():
    rows = given()
    place = good(rows)
    assert "gone" in only(changes.compared(rows, rows.drop(index=place), timings=True), "worse")
    assert only(changes.compared(rows.drop(index=place), rows, timings=True), "changed") == "new"


# ------------------------------------------------------------------------------------------------------- command


def test_exit_status_files_and_table(tmp_path, capsys):
    before, after = given(), given()
    after.loc[good(after), ["status", "reason"]] = ["error", "it broke"]
    old, new = save(before, tmp_path / "old"), save(after, tmp_path / "new")
    assert run(old, old, out=tmp_path / "out") == 0
    assert run(old, new, out=tmp_path / "out") == 1
    told = capsys.readouterr().out
    assert "status ok to error (it broke)" in told
    table = pd.read_csv(tmp_path / "out" / "compare.csv")
    assert list(table.columns) == ["experiment", *changes.COLUMNS]
    assert (table["outcome"] == "worse").sum() == 1
    assert "it broke" in (tmp_path / "out" / "compare.md").read_text()
    assert "it broke" in (tmp_path / "out" / "compare.html").read_text()


def test_committed_tables_alone_are_enough(tmp_path):
    before, after = given(), given()
    place = good(after)
    after.loc[place, ["bias", "bias_low", "bias_high"]] = [9.0, 8.0, 10.0]
    old, new = (save(rows, tmp_path / name, parquet=False) for rows, name in ((before, "old"), (after, "new")))
    assert run(old, old, out=tmp_path / "out") == 0
    assert run(old, new, out=tmp_path / "out") == 1


def test_timings_of_another_machine_are_compared_only_when_asked(tmp_path, capsys):
    before, after = given(), given()
    after["time_samples"] = [3 * samples for samples in after["time_samples"]]
    after["time_s"] *= 3
    old = save(before, tmp_path / "old")
    new = save(after, tmp_path / "new", machine=MACHINE | {"cores": 64, "load_average": [500.0]})
    assert run(old, new, out=tmp_path / "out") == 0
    assert "not compared: add --timings" in capsys.readouterr().out
    for asked in ("--timings", "timings=true"):
        assert run(old, new, asked, out=tmp_path / "out") == 1
        told = capsys.readouterr().out
        assert "WARNING: timings of different machines" in told
        assert "busy after" in told


def test_git_revisions_are_compared(tmp_path, monkeypatch, capsys):
    def git(*words):
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", *who, *words], cwd=tmp_path, check=True, capture_output=True)

    git("init")
    rows = given()
    for text in ("ok", "error"):
        rows.loc[good(given()), "status"] = text
        save(rows, tmp_path / "results", parquet=False)
        git("add", ".")
        git("commit", "-m", text)
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "out"
    assert run("HEAD", "HEAD", out=out) == 0
    assert run("HEAD~1", "HEAD", out=out) == 1
    assert run("HEAD:results/made_up", "HEAD~1:results", out=out) == 0
    assert run("HEAD~1", tmp_path / "results", out=out) == 1
    assert run("HEAD:nowhere", "HEAD", out=out) == 2
    assert "has no 'nowhere'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["here"], "name two results"),
        (["no-such-thing", "."], "neither a directory nor a git revision"),
        (["--output=/tmp/x", "."], "neither a directory nor a git revision"),
        ([".", "."], "no results"),
        ([".", ".", "timing=true"], "did you mean 'timings'"),
        ([".", ".", "timings=perhaps"], "allowed: false, true"),
    ],
)
def test_bad_input_is_told(words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["compare", *words]) == 2
    assert told in capsys.readouterr().err


def test_results_without_a_common_experiment_are_told(tmp_path, capsys):
    old = save(given().assign(experiment="one"), tmp_path / "old", "one")
    new = save(given().assign(experiment="two"), tmp_path / "new", "two")
    assert run(old, new, out=tmp_path / "out") == 2
    assert "no experiment in common" in capsys.readouterr().err


def test_stored_rows_without_single_calls_stay_readable_beside_new_ones(tmp_path):
    rows = given()
    old = BIAS_VARIANCE.typed(rows.drop(columns="time_samples"))
    both = pd.concat([old, BIAS_VARIANCE.typed(rows.assign(key=rows["key"] + "2"))])
    both.to_parquet(tmp_path / "rows.parquet", index=False)
    again = pd.read_parquet(tmp_path / "rows.parquet")
    assert again["time_samples"].isna().sum() == len(rows)
    assert compare.summary(changes.compared(again, again, timings=True)).startswith("Of ")
