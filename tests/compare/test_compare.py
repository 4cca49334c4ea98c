"""Comparing two results: planted changes are found, chance is not, and what cannot be compared is refused."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from helpers import experiment, loaded, small_rows

from bench import cli, compare
from bench.compare import cells, judging, sources
from bench.model import registry
from bench.report.tables import csv
from bench.studies.bias_variance.columns import COLUMNS
from bench.sweep import axes
from bench.sweep.columns import Columns
from bench.sweep.runner import blank

MACHINE = {"processor": "a chip", "cores": 2, "system": "Linux", "load_average": [0.1, 0.1, 0.1]}


def given(calls=20, seed=1):
    """Rows with times of single calls, spread by 5%."""
    rows = small_rows(backends=("jax",), estimators=("fobg", "reinforce"))
    generator = np.random.default_rng(seed)
    rows["time_samples"] = [time * (1 + 0.05 * generator.standard_normal(calls)) for time in rows["time_s"]]
    rows["time_s"] = [float(np.median(samples)) for samples in rows["time_samples"]]
    return rows


def compared(before, after, timings, columns: Columns = COLUMNS):
    return cells.compared(before, after, columns, timings)


def of_study(name, *words):
    """The columns of a study, and blank rows of one of its cells per word of ``scenes``."""
    made, found = loaded(f"study={name}", "backends=[jax]", "estimators=[fobg]", *words)
    rows = pd.DataFrame([blank(made, cell) | {"status": "ok"} for cell in found])
    return made.columns, made.columns.typed(rows)


def save(rows, directory, name="made_up", machine=MACHINE, parquet=True):
    """Rows as an experiment's directory."""
    place = directory / name
    place.mkdir(parents=True, exist_ok=True)
    columns = sources.columns_of(rows["study"].iloc[0])
    if parquet:
        columns.typed(rows).to_parquet(place / "rows.parquet", index=False)
    table = axes.table(replace(experiment(directory, name=name), columns=columns), columns.typed(rows))
    (place / "table.csv").write_text(csv(table))
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
    columns, before = of_study("three_errors")
    before = before.assign(model_error_rel=1e-13, program_error_rel=0.1)
    for name, value, expected in (
        ("model_error_rel", 5e-13, None),
        ("model_error_rel", 0.2, "worse"),
        ("program_error_rel", 0.11, None),
        ("program_error_rel", 0.01, "better"),
    ):
        found = compared(before, before.assign(**{name: value}), False, columns)
        assert set(found["outcome"]) - {"same"} == ({expected} if expected else set())


def test_growth_rates_that_are_apart_are_changed():
    columns, before = of_study("growth")
    before = before.assign(stretch_rate=1.0, stretch_low=0.9, stretch_high=1.1)
    after = before.assign(stretch_rate=2.0, stretch_low=1.8, stretch_high=2.2)
    assert only(compared(before, after, False, columns), "changed") == "growth rate 1.00 to 2.00"


VERDICTS = [
    ("gradient_check", "smooth", "wrong_adjoint", "worse"),
    ("gradient_check", "wrong_adjoint", "kink", "better"),
    ("gradient_check", "smooth", "marvellous", "changed"),
    ("stability", "ok", "wrong_sign", "worse"),
    ("stability", "wrong_sign", "inaccurate", "better"),
]


@pytest.mark.parametrize(("study", "was", "now", "outcome"), VERDICTS)
def test_verdicts_are_judged_by_the_order_of_their_study(study, was, now, outcome):
    columns, rows = of_study(study)
    found = compared(rows.assign(verdict=was), rows.assign(verdict=now), False, columns)
    assert only(found, outcome) == f"verdict {was} to {now}"


@pytest.mark.parametrize("study", list(registry.entries()["studies"]))
def test_the_columns_that_a_rule_needs_are_columns_of_the_study(study):
    columns = sources.columns_of(study)
    assert columns.judged
    for column in columns.judged:
        if column.judged.by == "interval":
            assert set(judging._ends(column, columns)) <= set(columns.by_name)
        if column.judged.by == "verdict":
            assert column.judged.order


def test_cells_are_matched_by_all_their_parameters():
    """Labels leave out defaults and timed calls; the parameters do not. Their order does not matter."""
    columns, rows = of_study("bias_variance", "scenes=[quadratic]")
    _, other = of_study("bias_variance[timed_calls=7]", "scenes=[quadratic]")
    assert set(compared(rows, other, False, columns)["change"]) == {"gone, it was ok", "new"}
    given = json.loads(rows["parameters"][0])
    turned = rows.assign(parameters=json.dumps(dict(reversed(given.items()))))
    assert list(compared(rows, turned, False, columns)["outcome"]) == ["same"]
    assert len(compared(rows, rows.assign(seed=1), False, columns)) == 2


def test_equal_results_are_the_same_whatever_the_noise_of_their_times():
    found = compared(given(seed=1), given(seed=2), timings=True)
    assert set(found["outcome"]) == {"same"}


@pytest.mark.parametrize(("factor", "outcome"), [(10.0, "worse"), (0.1, "better")])
@pytest.mark.parametrize("column", ["bias", "variance"])
def test_accuracy_beyond_the_intervals_is_a_change(factor, outcome, column):
    rows = given()
    place = good(rows)
    rows.loc[place, [column, f"{column}_low", f"{column}_high"]] = [2.0, 1.8, 2.2]
    after = rows.copy()
    after.loc[place, [column, f"{column}_low", f"{column}_high"]] *= factor
    assert only(compared(rows, after, timings=False), outcome).startswith(column)
    after.loc[place, "reason"] = "heavy tails"
    assert "doubtful" in only(compared(rows, after, timings=False), "changed")


def test_accuracy_within_the_intervals_is_none():
    rows = given()
    place = good(rows)
    rows.loc[place, ["bias", "bias_low", "bias_high"]] = [2.0, 1.8, 2.2]
    after = rows.copy()
    after.loc[place, ["bias", "bias_low", "bias_high"]] = [2.3, 2.1, 2.5]
    assert set(compared(rows, after, timings=False)["outcome"]) == {"same"}


def test_variances_without_intervals_are_judged_by_an_f_test():
    """Of equal variances at most 1% are reported as changed; fourfold ones of 64 repeats always are."""
    generator = np.random.default_rng(0)
    equal = generator.chisquare(63, (2000, 2)) / 63
    assert np.mean([judging.outside_f(a / b, 64, 64) for a, b in equal]) < 0.015
    assert np.mean([judging.outside_f(4 * a / b, 64, 64) for a, b in equal]) > 0.99


@pytest.mark.parametrize(("factor", "outcome"), [(2.0, "worse"), (0.5, "better")])
@pytest.mark.parametrize("calls", [5, 64])
def test_a_time_that_differs_by_more_than_its_spread_is_a_change(factor, outcome, calls):
    before, after = given(calls), given(calls, seed=2)
    place = good(after)
    after.at[place, "time_samples"] = factor * after.at[place, "time_samples"]
    after.loc[place, "time_s"] *= factor
    assert only(compared(before, after, timings=True), outcome).startswith("time")
    assert set(compared(before, after, timings=False)["outcome"]) == {"same"}


def test_a_time_that_differs_by_less_than_the_least_effect_is_none_however_sure():
    before, after = given(200), given(200)
    after["time_samples"] = [1.2 * samples for samples in after["time_samples"]]
    after["time_s"] *= 1.2
    assert set(compared(before, after, timings=True)["outcome"]) == {"same"}


def test_times_without_single_calls_are_judged_by_their_interquartile_range():
    before = given().drop(columns="time_samples")
    after = before.copy()
    place = good(after)
    before["time_iqr_s"] = after["time_iqr_s"] = 0.1 * before["time_s"]
    after.loc[place, "time_s"] *= 2
    assert only(compared(before, after, timings=True), "worse").startswith("time")
    after["time_iqr_s"] = np.nan
    found = compared(before, after, timings=True)
    assert set(found["outcome"]) == {"same"}
    assert found["time_judged_by"].str.startswith("not compared").any()


@pytest.mark.parametrize(("was", "now", "outcome"), [("ok", "error", "worse"), ("timeout", "ok", "better"), ("error", "crashed", "changed")])  # fmt: skip
def test_a_status_that_changed_is_a_change(was, now, outcome):
    before, after = given(), given()
    place = good(before)
    before.loc[place, "status"], after.loc[place, "status"] = was, now
    assert f"{was} to {now}" in only(compared(before, after, timings=True), outcome)


def test_cells_that_are_gone_or_new_are_reported():
    rows = given()
    place = good(rows)
    assert "gone" in only(compared(rows, rows.drop(index=place), timings=True), "worse")
    assert only(compared(rows.drop(index=place), rows, timings=True), "changed") == "new"


# ------------------------------------------------------------------------------------------------------- command


def test_exit_status_files_and_table(tmp_path, capsys):
    before, after = given(), given()
    after.loc[good(after), ["status", "reason"]] = ["error", "it broke"]
    old, new = save(before, tmp_path / "old"), save(after, tmp_path / "new")
    assert run(old, old, out=tmp_path / "out") == 0
    assert run(old, new, out=tmp_path / "out") == 1
    printed = capsys.readouterr().out
    assert "status ok to error (it broke)" in printed
    table = pd.read_csv(tmp_path / "out" / "compare.csv")
    assert list(table.columns) == ["experiment", *cells.FIRST, *cells.both_sides(COLUMNS.judged), *cells.LAST]
    assert (table["outcome"] == "worse").sum() == 1
    assert "it broke" in (tmp_path / "out" / "compare.md").read_text()
    assert "it broke" in (tmp_path / "out" / "compare.html").read_text()


def test_committed_tables_are_enough(tmp_path):
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
        printed = capsys.readouterr().out
        assert "WARNING: timings of different machines" in printed
        assert "busy after" in printed


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
    ("words", "said"),
    [
        (["here"], "name two results"),
        (["no-such-thing", "."], "neither a directory nor a git revision"),
        (["--output=/tmp/x", "."], "neither a directory nor a git revision"),
        ([".", "."], "no results"),
        ([".", ".", "timing=true"], "did you mean 'timings'"),
        ([".", ".", "timings=perhaps"], "allowed: false, true"),
    ],
)
def test_bad_input_is_refused(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["compare", *words]) == 2
    assert said in capsys.readouterr().err


def test_results_kept_in_git_are_found_in_their_own_folder(tmp_path):
    before, after = given(), given()
    after.loc[good(after), ["bias", "bias_low", "bias_high"]] = [9.0, 8.0, 10.0]
    old = save(before, tmp_path / "old" / "standard", parquet=False).parent
    new = save(after, tmp_path / "new" / "standard", parquet=False).parent
    assert run(old, new, out=tmp_path / "out") == 1
    save(before, new)
    assert run(old, new, out=tmp_path / "out") == 0, "results of one's own come before those of the standard folder"


def test_results_of_older_versions_are_refused(tmp_path, capsys):
    new = save(given(), tmp_path / "new")
    for name, parquet in (("table", False), ("rows", True)):
        place = tmp_path / name / "made_up"
        place.mkdir(parents=True)
        older = given().drop(columns=["study", "parameters"])
        older.to_parquet(place / "rows.parquet") if parquet else older.to_csv(place / "made_up.csv")
        assert run(place, new, out=tmp_path / "out") == 2
        assert "made by an older version" in capsys.readouterr().err
    both = pd.concat([given().assign(parameters="").iloc[:3], given()])
    assert run(save(both, tmp_path / "both"), new, out=tmp_path / "out") == 0
    assert "3 rows before were made by an older version and are left out" in capsys.readouterr().out


def test_a_table_with_several_lines_per_cell_has_the_worst_verdict_of_each(tmp_path):
    _, rows = of_study("gradient_check", "scenes=[pushing]")
    rows = rows.assign(experiment="some")
    fine, wrong = (
        pd.concat([rows.assign(verdict=v) for v in some]) for some in (["kink"] * 3, ["jump", "zero", "kink"])
    )
    old, new = (save(r, tmp_path / n, "some", parquet=False) for r, n in ((fine, "old"), (wrong, "new")))
    assert run(old, new, out=tmp_path / "out") == 1
    assert "verdict kink to jump" in (tmp_path / "out" / "compare.csv").read_text()


@pytest.mark.parametrize("study", list(registry.entries()["studies"]))
@pytest.mark.parametrize("parquet", [True, False])
def test_results_of_every_study_are_compared(study, parquet, tmp_path):
    """One of them gave no result: rows of every kind of column, from Parquet and from the committed table."""
    columns, rows = of_study(study, "scenes=[pushing,quadratic]")
    rows = rows.assign(experiment="some", **{column.name: 1.0 for column in columns.judged if column.kind == "number"})
    old = save(rows, tmp_path / "old", "some", parquet=parquet)
    assert run(old, old, out=tmp_path / "out") == 0
    rows.loc[0, "status"] = "error"
    assert run(old, save(rows, tmp_path / "new", "some", parquet=parquet), out=tmp_path / "out") == 1
    assert "error" in (tmp_path / "out" / "compare.html").read_text()


def test_results_without_a_common_experiment_are_refused(tmp_path, capsys):
    old = save(given().assign(experiment="one"), tmp_path / "old", "one")
    new = save(given().assign(experiment="two"), tmp_path / "new", "two")
    assert run(old, new, out=tmp_path / "out") == 2
    assert "no experiment in common" in capsys.readouterr().err


def test_stored_rows_without_single_calls_stay_readable_beside_new_ones(tmp_path):
    rows = given()
    old = COLUMNS.typed(rows.drop(columns="time_samples"))
    both = pd.concat([old, COLUMNS.typed(rows.assign(key=rows["key"] + "2"))])
    both.to_parquet(tmp_path / "rows.parquet", index=False)
    again = pd.read_parquet(tmp_path / "rows.parquet")
    assert again["time_samples"].isna().sum() == len(rows)
    assert compare.report.summary(compared(again, again, timings=True)).startswith("Of ")
