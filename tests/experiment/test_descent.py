"""A share of a descent as an axis: one path per scene, whose thetas all cells have, and what decides its identity."""

import json
import shlex
from dataclasses import replace

import numpy as np
import pytest
from bench.plugins.studies.bias_variance.columns import COLUMNS
from helpers import loaded
from trees import ROOT

import bench
from bench.errors import Unsupported, UserError
from bench.experiment import cell as cell_module
from bench.experiment.axes import axes, with_axes
from bench.experiment.parameters import number_problems, parsed
from bench.measure import descent
from bench.report.reproduce import commands
from bench.run.execute import execute
from bench.run.shared import Shared

PUSHING = ("scenes=[pushing]", "scene.pushing.sigma=0.1", "backends=[numpy]", "estimators=[fobg]")
SMALL = ("samples=8", "repeats=4", "reference.samples=256", "timing=false", "workers=0")
BOWL = ("scenes=[quadratic]", "backends=[numpy]", "estimators=[fobg,reinforce]", *SMALL)


@pytest.fixture(autouse=True)
def forget():
    yield
    cell_module._reference_keys.clear()


def run(folder, *words):
    finished = execute(loaded(*words, f"results_dir={folder}")[0])
    return finished.experiment, finished.rows()


def keys(*words):
    return [cell.key for cell in loaded(*words)[1]]


def problem(scene="quadratic", **settings):
    return bench.problem(scene, backend="numpy", **settings)


# ------------------------------------------------------------------------------------------------------------ the path


def test_costs_fall_along_a_descent_and_shares_are_of_the_gain():
    # J = sum of c_i theta_i^2 plus a constant has its optimum at 0
    found = descent.descend(problem())
    assert np.all(np.diff(found.costs) < 0)
    start, half, most = (found.at(share) for share in (0.0, 0.5, 0.99))
    assert start.theta == tuple(problem().program.theta0)
    along = dict(zip(half.along["share"], half.along["cost"], strict=True))
    assert along[0.5] == pytest.approx((along[0.0] + found.costs[-1]) / 2)
    assert np.linalg.norm(most.theta) < np.linalg.norm(half.theta) < np.linalg.norm(start.theta)
    assert start.start_norm == most.start_norm == found.gradients[0]


def test_a_jump_is_descended_with_scores():
    # f = 1 for theta > 0: J falls towards negative thetas, and its gradients of samples are all 0
    assert descent.descend(problem("heaviside")).at(0.9).theta[0] < -0.05


@pytest.mark.parametrize(
    ("scene", "settings", "reason"),
    [
        ("linear", {}, "still falls after"),
        ("quadratic", {"theta0": [0.0] * 5}, "may be an optimum"),
        ("constant", {}, "may be an optimum"),
        ("quadratic", {"theta0": [1e200] * 5}, "not finite"),
    ],
)
def test_no_optimum_no_progress_and_costs_that_are_not_finite_have_a_reason(scene, settings, reason):
    found = descent.descend(problem(scene, **settings))
    assert reason in found.reason
    with pytest.raises(Unsupported, match=reason):
        found.at(0.5)


def test_a_problem_is_placed_on_the_descent_of_its_path():
    own = descent.descend(bench.problem("quadratic"))
    assert tuple(problem(descent=0.5).program.theta0) == own.at(0.5).theta
    with pytest.raises(UserError, match="descent=1 must be at least 0 and below 1"):
        problem(descent=1)


# ------------------------------------------------------------------------------------------------------------ identity


def test_a_share_of_zero_changes_no_key():
    for words in (PUSHING, (*PUSHING, "theta=[mass]"), ("scenes=[quadratic]", "sweep.theta0=[[1,0,0,0,2]]")):
        assert keys(*words) == keys(*words, "descent=0") == keys(*words, "sweep.descent=[0]", "path=[impulse,rk4]")


def test_keys_hash_share_path_and_revision_and_no_theta(monkeypatch):
    def refuse(_):
        raise AssertionError("planning computes no descent")

    monkeypatch.setattr(descent, "descend", refuse)
    words = (*PUSHING, "descent=0.9")
    different = [keys(*PUSHING), keys(*words), keys(*PUSHING, "descent=0.5"), keys(*words, "path=[impulse,rk4]")]
    different += [
        keys(*words, "path=['penalty[stiffness=100]',semi_implicit_euler]"),
        keys(*words, "theta0=" + str([0.2] * 30)),
    ]
    different += [keys(*words, "path=[penalty,semi_implicit_euler,numpy]")]
    assert len({tuple(some) for some in different}) == len(different)
    cell = loaded(*words)[1][0]
    before = [cell.key, cell.program_key, cell.reference_key]
    placed = replace(cell, point=descent.DescentPoint((0.0,) * 30, 1.0, {}))
    assert [placed.key, placed.program_key, placed.reference_key] == before
    monkeypatch.setattr(descent, "REVISION", 2)
    cell_module._reference_keys.clear()
    again = loaded(*words)[1][0]
    assert not {again.key, again.program_key, again.reference_key} & set(before)
    assert keys(*PUSHING) == different[0]


def test_one_path_for_every_law_stiffness_backend_and_estimator():
    words = (
        "scenes=[pushing]",
        "contacts=[penalty,impulse]",
        "contact.penalty.damping=0",
        "backends=[numpy,jax]",
        "estimators=[fobg,reinforce]",
        "descent=0.9",
    )
    of = loaded(*words, "sweep.penalty.stiffness=[1e2,1e5]")[1]
    assert len(of) == 12  # the stiffness is no parameter of impulse
    assert len({cell.path.descent_key for cell in of}) == 1
    assert (
        len({cell.path.descent_key for cell in loaded(*words, "sweep.sigma=[0.1,0.3]", "sweep.horizon=[10,20]")[1]})
        == 4
    )


def test_a_program_before_its_descent_has_no_theta():
    program = loaded(*PUSHING, "descent=0.9")[1][0].program()
    assert program.closed_form_gradient() is None
    with pytest.raises(Unsupported, match="once the descent is computed"):
        program.theta0  # noqa: B018


def test_studies_that_start_elsewhere_and_scenes_without_a_backend_refuse_a_share():
    cell = loaded("study=identify", "scenes=[sliding_block]", "backends=[numpy]", "descent=0.5")[1][0]
    assert "starts where its own settings say" in cell.refusal()[1]
    cell = loaded("scenes=[tossed_box]", "backends=[mujoco]", "estimators=[fobg]", "descent=0.5")[1][0]
    assert cell.refusal()[0] in ("unsupported", "unavailable")


# ------------------------------------------------------------------------------------------------------------- running


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    return run(tmp_path_factory.mktemp("descents"), *BOWL, "sweep.descent=[0,0.5,0.9]", "name=bowl")


def test_all_cells_of_a_share_have_the_theta_of_one_stored_path(ran):
    experiment, rows = ran
    assert list(rows["status"]) == ["ok"] * 6
    files = list((experiment.results_dir / "references").glob("descent_*.json"))
    assert len(files) == 1
    found = descent.DescentPath(**Shared(experiment).load(files[0].stem))
    for share, part in rows.groupby("descent"):
        expected = found.at(share).theta if share else tuple(problem().program.theta0)
        assert {tuple(point) for point in part["point"]} == {expected}
    assert rows["start_norm"].isna().tolist() == (rows["descent"] == 0).tolist()
    on_path = rows[rows["descent"] > 0]
    np.testing.assert_allclose(on_path["rmse_start"], on_path["rmse"] / found.gradients[0])


def test_a_stored_path_is_not_computed_again(ran, monkeypatch):
    experiment, rows = ran

    def refuse(_):
        raise AssertionError("the path is stored")

    monkeypatch.setattr(descent, "descend", refuse)
    _, again = run(experiment.results_dir, *BOWL, "sweep.descent=[0.5,0.75]", "name=other")
    assert list(again["status"]) == ["ok"] * 4
    assert set(rows.loc[rows["descent"] == 0.5, "key"]) <= set(again["key"])


def test_the_share_is_an_axis_a_column_and_part_of_the_problem(ran):
    experiment, rows = ran
    assert [axis.column for axis in axes(experiment.sweep, rows)] == ["descent"]
    assert with_axes(experiment.sweep, rows)["descent"].tolist() == rows["descent"].tolist()
    assert number_problems(rows).nunique() == 3
    assert number_problems(rows, without=["descent"]).nunique() == 1
    assert [parsed(text)["theta"] and parsed(text)["theta"]["descent"] for text in rows["parameters"]] == [
        None,
        None,
        0.5,
        0.5,
        0.9,
        0.9,
    ]


def test_a_row_on_a_descent_is_run_again_by_its_command(ran):
    experiment, rows = ran
    for words, key in zip(commands(experiment, rows), rows["key"], strict=True):
        assert keys(*(shlex.split(word)[0] for word in words)) == [key]


def test_tables_show_the_descent_and_errors_in_units_of_its_start(ran):
    experiment, rows = ran
    tables = {table.name: table.frame for table in experiment.study.views(experiment, rows).tables}
    path = tables["descent"]
    assert path["share"].tolist() == [0.0, 0.25, 0.5, 0.75, 0.9]
    assert path["cost"].is_monotonic_decreasing
    errors = tables["along_descent"]
    assert len(errors) == 6
    assert np.isfinite(errors[["rmse_rel", "rmse_start", "cosine"]]).all(axis=None)


def test_no_progress_is_a_row_with_a_reason(tmp_path):
    _, rows = run(tmp_path, "scenes=[linear]", *BOWL[1:], "descent=0.9")
    assert list(rows["status"]) == ["unsupported"] * 2
    assert all("still falls after" in reason for reason in rows["reason"])


def test_rows_stored_before_the_column_existed_have_a_share_of_zero(ran):
    old = ran[1].drop(columns=["descent", "rmse_start"])
    assert COLUMNS.typed(old)["descent"].tolist() == [0.0] * len(old)
    stored = bench.load(ROOT / "results" / "standard" / "engines")
    assert (stored["descent"] == 0).all()
    assert all(json.loads(text)["theta"] is None for text in stored["parameters"])
