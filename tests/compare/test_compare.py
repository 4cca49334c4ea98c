"""Comparing two results: planted changes are found, chance is not, and what cannot be compared is refused."""

from __future__ import annotations

import itertools
import json
import math
import shutil
import subprocess

import numpy as np
import pandas as pd
import planted
import pytest
from bench.plugins.studies.bias_variance.columns import COLUMNS
from helpers import small_rows, unmeasured

from bench import cli
from bench.compare import cells, command, history, report, sources, timings
from bench.experiment.columns import Column, Columns
from bench.measure.statistics import UNEXPLAINED
from bench.model import registry

MACHINE = {"processor": "a chip", "cores": 2, "system": "Linux", "load_average": [0.1, 0.1, 0.1]}


GIVEN = small_rows(backends=("jax",), estimators=("fobg", "reinforce"))


def given():
    """Made-up rows of two estimators."""
    return GIVEN.copy()


def compared(before, after, columns: Columns = COLUMNS, again=()):
    return cells.compare_cells(before, after, columns, again)[0]


def of_study(name, *words):
    """The columns of a study, and blank rows of one of its cells per word of ``scenes``."""
    estimators = ["estimators=[fobg]"] if "estimator" in registry.usable("studies", name.partition("[")[0]).axes else []
    made, rows = unmeasured(f"study={name}", "backends=[jax]", *estimators, *words)
    return made.columns, rows


def save(rows, directory, name="made_up"):
    """Rows as an experiment's directory."""
    place = directory / name
    place.mkdir(parents=True, exist_ok=True)
    sources.columns_of(rows["study"].iloc[0]).typed(rows).to_parquet(place / "rows.parquet", index=False)
    (place / "run.json").write_text(json.dumps({"machine": MACHINE}))
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


def interval(name, low, middle, high):
    return {name: middle, f"{name}_low": low, f"{name}_high": high}


ERRORS = {"model_error_rel": 1e-13, "program_error_rel": 0.1}
RATE = {"stretch_rate": 1.0, "stretch_low": 0.9, "stretch_high": 1.1}
JUDGED = [
    ("three_errors", ERRORS, {"model_error_rel": 5e-13}, "same", ""),
    ("three_errors", ERRORS, {"model_error_rel": 0.2}, "worse", ""),
    ("three_errors", ERRORS, {"program_error_rel": 0.11}, "same", ""),
    ("three_errors", ERRORS, {"program_error_rel": 0.01}, "better", ""),
    ("growth", RATE, {name: 2 * value for name, value in RATE.items()}, "changed", "growth rate 1.00 to 2.00"),
    *(
        (study, {"verdict": was}, {"verdict": now}, outcome, f"verdict {was} to {now}")
        for study, was, now, outcome in (
            ("gradient_check", "smooth", "wrong_adjoint", "worse"),
            ("gradient_check", "wrong_adjoint", "kink", "better"),
            ("gradient_check", "smooth", "marvellous", "changed"),
            ("stability", "ok", "wrong_sign", "worse"),
            ("stability", "wrong_sign", "inaccurate", "better"),
        )
    ),
    *(
        (
            "bias_variance",
            interval(name, 1.8, 2.0, 2.2),
            interval(name, 1.8 * factor, 2.0 * factor, 2.2 * factor) | remark,
            outcome,
            said,
        )
        for name in ("bias", "variance")
        for factor, remark, outcome, said in (
            (10.0, {}, "worse", name),
            (0.1, {}, "better", name),
            (10.0, {"reason": "heavy tails"}, "changed", "doubtful"),
            (10.0, {"reason": UNEXPLAINED}, "changed", UNEXPLAINED),
            (10.0, {"reason": "physics: no wind"}, "worse", name),
            (10.0, {"reason": "physics: no wind; heavy tails"}, "changed", "doubtful"),
        )
    ),
    ("bias_variance", interval("bias", 1.8, 2.0, 2.2), interval("bias", 2.1, 2.3, 2.5), "same", ""),
]
"""Studies, columns before, columns that differ after, and how compare judges each cell."""


@pytest.mark.parametrize(("study", "was", "now", "outcome", "said"), JUDGED)
def test_a_column_is_judged_by_its_rule(study, was, now, outcome, said):
    columns, rows = of_study(study)
    before = rows.assign(**was)
    found = compared(before, before.assign(**now), columns)
    assert set(found["outcome"]) == {outcome}
    assert all(said in change for change in found["change"])


def test_cells_are_matched_by_all_their_parameters():
    """Labels leave out defaults and timed calls; the parameters do not. Their order does not matter."""
    columns, rows = of_study("bias_variance", "scenes=[quadratic]")
    _, other = of_study("bias_variance[timed_calls=7]", "scenes=[quadratic]")
    assert set(compared(rows, other, columns)["change"]) == {"gone, it was ok", "new"}
    given = json.loads(rows["parameters"][0])
    turned = rows.assign(parameters=json.dumps(dict(reversed(given.items()))))
    older = rows.assign(parameters=json.dumps(given | {"scene": {"name": "quadratic"}}))
    for other in (turned, older):  # a parameter that a row lacks has its default
        assert list(compared(rows, other, columns)["outcome"]) == ["same"]
    assert len(compared(rows, rows.assign(seed=1), columns)) == 2


def test_cells_that_the_identity_columns_do_not_distinguish_are_named_by_their_parameters():
    (columns, one), (_, two) = (
        of_study(f"bias_variance[timed_calls={count}]", "scenes=[quadratic]") for count in (3, 7)
    )
    rows = pd.concat([one, two], ignore_index=True)
    table = compared(rows, rows.assign(status="error"), columns).assign(experiment="some")
    names = report.cell_names(table)
    assert [name.rpartition(", ")[2] for name in names] == [f"bias_variance.timed_calls={count}" for count in (3, 7)]


# --------------------------------------------------------------------------------------------- paired estimates


def paired(mean=(1.0, 2.0), variance=0.5, reference=(1.1, 1.9), se=0.0, **more):
    """One ok row that stores its mean estimate, and its error from that."""
    row = given().loc[[good(given())]].assign(variance=variance, reference_se=se, **more)
    row["mean_estimate"], row["reference_gradient"] = [np.array(mean)], [np.array(reference)]
    return row.assign(rmse=np.hypot(np.linalg.norm(np.subtract(mean, reference)), np.sqrt(variance)))


@pytest.mark.parametrize("factor", [1.02, 1.1, -1.0])
@pytest.mark.parametrize("variance", [0.0, 0.5, 1e8], ids=["exact", "usual", "exploding"])
def test_scaled_estimates_are_worse_on_equal_noise_however_large_their_variance(factor, variance):
    before = paired(variance=variance, reference=(1.0, 2.0))
    after = paired(factor * np.array([1.0, 2.0]), factor**2 * variance, (1.0, 2.0))
    found = compared(before, after)
    # a sign changes no spread, so at a huge variance it is a change that nothing shows to be worse
    assert only(found, "changed" if factor < 0 and variance > 1e3 else "worse").startswith("RMSE")
    assert compared(after, before)["outcome"].iloc[0] in ("better", "changed")


HEAVY = {"reason": "heavy tails"}
NO_BIAS, BIAS = interval("bias", 0.0, 0.0, 0.1), interval("bias", 0.9, 1.0, 1.1)
MOVED = paired(reference=(2.1, 1.9), **BIAS)
PAIRED = [
    (paired(**HEAVY), paired((1.5, 2.5), **HEAVY), "worse", "on the same noise"),
    (paired(), paired((1 + 1e-9, 2.0)), "same", ""),
    (paired(), paired((1.0001, 2.0)), "changed", "moved by"),
    # intervals of the bias move with the reference; the estimates on the same noise are what they were
    (paired(**NO_BIAS), MOVED, "changed", "the same estimates, but the reference moved by 1.00"),
    (paired(**NO_BIAS), MOVED.assign(reference_se=0.5), "same", ""),
    # the reference of before is the measure, so a fault that the reference shares cannot hide
    (paired(), paired((1.1, 2.2), 0.605, (1.21, 2.09)), "worse", ""),
]
"""Rows before and after, and how compare judges them."""


@pytest.mark.parametrize(
    ("before", "after", "outcome", "said"), PAIRED, ids=lambda value: value if isinstance(value, str) else ""
)
def test_estimates_on_the_same_noise_are_judged_by_themselves(before, after, outcome, said):
    found = compared(before, after)
    assert list(found["outcome"]) == [outcome]
    assert said in found["change"][0]


def test_planted_faults_of_the_gradient_are_caught():
    found = planted.judged("quadratic", ("none", "gradient * 1.02", "gradient * 1.1", "sign of one component"))
    assert list(found["outcome"]) == ["same", "worse", "worse", "worse"]


# ------------------------------------------------------------------------------------------------------- times


def runs(count, seed=0, spread=0.1, cells=40):
    """Rows of one experiment run several times: times of a cell spread between runs."""
    generator = np.random.default_rng(seed)
    two = given().iloc[:2]
    rows = pd.concat([two.assign(seed=i) for i in range(cells // 2)], ignore_index=True)
    rows["key"] = rows.index.astype(str)
    usual = np.exp(generator.normal(-7, 1, len(rows)))
    made = []
    for _ in range(count):
        load = generator.normal(0, spread)
        time = usual * np.exp(load + generator.normal(0, spread, len(rows)))
        made.append(rows.assign(time_s=time))
    return made


def test_times_of_unchanged_code_are_the_same_although_every_call_of_one_run_agrees():
    """As in load, a run is slower or faster as a whole, and each cell by itself; at most 1% of cells are alarms."""
    generator, again = np.random.default_rng(2), 2
    usual, alarms, cells, repeats = generator.normal(-7, 1, 40), 0, 40, 100
    for _ in range(repeats):
        logs = usual + generator.normal(0, 0.2, (2 + again, 1)) + generator.normal(0, 0.2, (2 + again, cells))
        alarms += len(timings.judge_times("time", *map(pd.Series, np.exp(logs)))[0])
    assert alarms <= 0.01 * cells * repeats


def test_a_time_beyond_the_spread_between_runs_is_a_change_where_times_are_asked_for(tmp_path):
    before, after, *more = runs(5, spread=0.05, cells=10)
    for factor, outcome in ((0.25, "better"), (4.0, "worse")):
        found = after.assign(time_s=after["time_s"].where(after.index != 0, after["time_s"] * factor))
        assert only(compared(before, found, again=more), outcome).startswith("time")
    old, new, *again = (save(rows, tmp_path / str(i)) for i, rows in enumerate((before, found, *more)))
    assert run(old, new, out=tmp_path / "out") == 0
    assert run(old, new, f"again={','.join(map(str, again))}", out=tmp_path / "out") == 1


def test_cells_that_are_gone_or_new_or_have_another_status_are_reported():
    rows = given()
    place = good(rows)
    assert "gone" in only(compared(rows, rows.drop(index=place)), "worse")
    assert only(compared(rows.drop(index=place), rows), "changed") == "new"
    for was, now, outcome in (("ok", "error", "worse"), ("timeout", "ok", "better"), ("error", "crashed", "changed")):
        before, after = (rows.assign(status=rows["status"].where(rows.index != place, one)) for one in (was, now))
        assert f"{was} to {now}" in only(compared(before, after), outcome)


# ------------------------------------------------------------------------------------------------------- command


@pytest.mark.parametrize("study", ["bias_variance", "gradient_check"])
def test_files_say_what_the_exit_status_says(study, tmp_path, capsys):
    """Rows have every kind of column."""
    columns, before = of_study(study, "scenes=[pushing,quadratic]")
    numbers = {column.name: 1.0 for column in columns.compared if column.kind == "number"}
    before = before.assign(experiment="some", **numbers)
    after = before.copy()
    after.loc[0, ["status", "reason"]] = ["error", "it broke\x00 <badly> & \x1b[31m"]
    old, new = save(before, tmp_path / "old", "some"), save(after, tmp_path / "new", "some")
    out = tmp_path / "out"
    for other, failures in ((old, 0), (new, 1)):
        assert run(old, other, out=out) == failures
        table = pd.read_csv(out / "compare.csv")
        assert len(table) == len(before)
        assert (table["outcome"] == "worse").sum() == failures
    assert list(table.columns) == ["experiment", *cells.FIRST, *cells.both_sides(columns.compared), *cells.LAST]
    assert "status ok to error (it broke" in capsys.readouterr().out
    assert "it broke" in (out / "compare.md").read_text()


@pytest.mark.slow
def test_git_revisions_are_compared(tmp_path, monkeypatch, capsys):
    def git(*words):
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", *who, *words], cwd=tmp_path, check=True, capture_output=True)

    git("init")
    rows = given()
    for text in ("ok", "error"):
        rows.loc[good(given()), "status"] = text
        save(rows, tmp_path / "results")
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


def test_results_kept_in_git_are_found_in_their_own_folder(tmp_path):
    before, after = given(), given()
    after.loc[good(after), ["bias", "bias_low", "bias_high"]] = [9.0, 8.0, 10.0]
    old = save(before, tmp_path / "old" / "standard").parent
    new = save(after, tmp_path / "new" / "standard").parent
    assert run(old, new, out=tmp_path / "out") == 1
    save(before, new)
    assert run(old, new, out=tmp_path / "out") == 0, "results of one's own come before those of the standard folder"


@pytest.mark.parametrize(
    ("name", "rows", "said"),
    [
        (
            "made_up",
            pd.concat([given().iloc[:3].assign(parameters="", key=list("abc")), given()]),
            "have no parameters",
        ),
        ("other", given().assign(experiment="other"), "no experiment in common"),
    ],
    ids=["parameters", "experiment"],
)
def test_what_cannot_be_compared_is_refused(name, rows, said, tmp_path, capsys):
    old, new = save(rows, tmp_path / "old", name), save(given(), tmp_path / "new")
    assert run(old, new, out=tmp_path / "out") == 2
    assert said in capsys.readouterr().err


# ----------------------------------------------------------------------------------------------------- history


def test_history_follows_errors_and_failures_in_the_order_given(tmp_path):
    rows = given()
    rows = rows.assign(bias=0.6, variance=0.64)
    worse = rows.assign(bias=1.2, variance=2.56)
    worse.loc[good(worse), "status"] = "error"
    places = [save(r, tmp_path / name) for name, r in (("a", rows), ("b", rows), ("c", worse))]
    assert cli.main(["history", *map(str, places), f"out={tmp_path / 'out'}"]) == 0
    table = pd.read_csv(tmp_path / "out" / "history.csv")
    fobg = table[table["series"] == "fobg"]
    assert list(fobg["error"]) == [1.0, 1.0, 2.0]
    assert list(fobg["failed"] - fobg["failed"].iloc[0]) == [0, 0, 1]
    assert (tmp_path / "out" / "history.png").stat().st_size > 0
    assert "fobg" in (tmp_path / "out" / "history.plotted.csv").read_text()


def test_history_draws_what_changed():
    """A panel per series that moved by more than 1% or failed elsewhere; NaN is no change."""
    lines = [
        (result, "some", series, "RMSE", error, 0 if math.isnan(error) else 3, moved, failed, 4)
        for series, errors, moves, failures in (
            ("same", (1.0, 1.001, 0.999), (0, 0, 0), (0, 0, 0)),
            ("much", (1.0, 3.0, 1.0), (math.nan,) * 3, (0, 0, 0)),
            ("lost", (1.0, 1.0, 1.0), (0, 0, 0), (1, 1, 2)),
            ("moved", (1.0, 1.0, 1.0), (0, 0.01, 0.01), (0, 0, 0)),
            ("unknown", (math.nan,) * 3, (math.nan,) * 3, (4, 4, 4)),
        )
        for result, error, moved, failed in zip("abc", errors, moves, failures, strict=True)
    ]
    names = ["result", "experiment", "series", "column", "error", "cells", "moved", "failed", "of"]
    made = history.views(pd.DataFrame(lines, columns=names))
    (chart,) = made.charts
    assert list(dict.fromkeys(chart.frame["line"])) == ["some: much", "some: lost", "some: moved"]
    assert chart.panel_notes == {"some: lost": "failed: 1, 1, 2 of 4"}


def test_a_gradient_that_a_release_of_an_engine_changes_is_told(tmp_path):
    """By compare and by history, with the versions, although the errors of both releases are 0 where no noise is."""
    columns, rows = of_study("engines", "scenes=[bounce_once]", "contacts=[penalty]")
    rows = rows.assign(bias=0.0, program_error_rel=1e-5)
    before = rows.assign(gradient=[[1.0, -2.0]] * len(rows), versions="numpy=2;newton:newton=1.0.0")
    after = rows.assign(gradient=[[1.0, -2.001]] * len(rows), versions="numpy=2;newton:newton=1.8.0")
    found = compared(before, after, columns)
    assert only(found, "changed") == "gradient moved by 4.5e-4 of its norm"
    older = columns.typed(before.drop(columns="gradient"))
    assert [set(compared(one, before, columns)["outcome"]) for one in (before, older)] == [{"same"}] * 2
    assert command.version_remarks(before, after) == ["other versions: newton:newton 1.0.0 to 1.8.0"]
    places = [str(save(r, tmp_path / name)) for name, r in (("a", before), ("b", after))]
    assert cli.main(["history", *places, f"out={tmp_path / 'out'}"]) == 0
    table = pd.read_csv(tmp_path / "out" / "history.csv")
    assert list(table["moved"].round(5)) == [0.0, 0.00045]


# --------------------------------------------------------------------------------------------------- fail closed


def sides(tmp_path):
    """Two equal results of two experiments."""
    for side, name in itertools.product(("before", "after"), ("made_up", "other")):
        save(given().assign(experiment=name), tmp_path / side, name)
    return [tmp_path / "before", tmp_path / "after"]


def pend(rows, folder):
    """Rows as those of a run that was killed before it merged them."""
    sources.Store(folder, sources.columns_of(rows["study"].iloc[0])).append(
        *json.loads(rows.to_json(orient="records", double_precision=15))
    )


@pytest.mark.parametrize("left", ["nothing", "an empty folder", "a part", "all"])
def test_an_experiment_that_vanishes_is_worse_and_pending_rows_are_read(tmp_path, left):
    before, after = sides(tmp_path)
    shutil.rmtree(after / "other")
    rows = given().assign(experiment="other")
    if left == "an empty folder":
        (after / "other" / "pending").mkdir(parents=True)
    elif left != "nothing":
        pend(rows if left == "all" else rows.drop(index=good(rows)), after / "other")
    assert run(before, after, out=tmp_path / "out") == (left != "all")
    outcomes = pd.read_csv(tmp_path / "out" / "compare.csv")["outcome"]
    gone = {"a part": 1, "all": 0}.get(left, (rows["status"] == "ok").sum())
    assert (len(outcomes), (outcomes == "worse").sum()) == (2 * len(rows), gone)
    assert run(after, before, out=tmp_path / "out") == 0, "an experiment that is new is no fault"
    if left == "all":
        assert cli.main(["history", str(before), str(after), f"out={tmp_path / 'out'}"]) == 0
        assert set(pd.read_csv(tmp_path / "out" / "history.csv")["experiment"]) == {"made_up", "other"}


def test_results_with_impossible_values_cannot_be_judged(tmp_path, capsys):
    """On either side: a row that is left out would be new or gone."""
    before, after = sides(tmp_path)
    path = before / "other" / "rows.parquet"
    pd.read_parquet(path).astype({"variance": object}).assign(variance="x").to_parquet(path)
    for pair in ((before, after), (after, before)):
        assert run(*pair, out=tmp_path / "out") == 2
        assert "row 1: variance='x' is negative, or is not a number" in capsys.readouterr().err


@pytest.mark.parametrize("study", list(registry.entries()["studies"]))
def test_a_judged_value_that_is_lost_is_worse(study):
    columns, rows = of_study(study, "scenes=[pushing]")
    empty = {"number": math.nan, "text": "", "list": [math.nan]}
    full = {"number": 1.0, "text": "ok", "list": [1.0]}
    values = [{c.name: [kinds[c.kind]] for c in columns.compared if not c.measured} for kinds in (full, empty)]
    before, after = (rows.iloc[:1].assign(**one) for one in values)
    assert only(compared(before, after, columns), "worse").startswith("no value any more: ")
    assert "worse" not in set(compared(after, before, columns)["outcome"])
    assert set(compared(after, after, columns)["outcome"]) == {"same"}


def test_a_number_of_a_study_without_rules_that_is_lost_is_worse():
    columns = Columns.of(Column("size"))
    rows = given().iloc[:1]
    assert "size" in only(compared(rows.assign(size=1.0), rows.assign(size=math.nan), columns), "worse")


@pytest.mark.parametrize("change", ["none", "a number", "gone"])
def test_rows_of_a_study_that_is_not_installed_are_the_same_if_their_files_are(tmp_path, capsys, change):
    before, after = tmp_path / "before", tmp_path / "after"
    for side in (before, after):
        save(given(), side)
        if side == before or change != "gone":
            (side / "alien").mkdir()
            bias = 2.0 if change == "a number" and side == after else 1.0
            alien = given().iloc[:2].assign(study="alien", experiment="alien", bias=bias)
            alien.to_parquet(side / "alien" / "rows.parquet")
    status = {"none": 0, "a number": 2, "gone": 1}[change]
    assert run(before, after, out=tmp_path / "out") == status
    assert ("study 'alien' is not installed" in capsys.readouterr().err) == (change == "a number")
