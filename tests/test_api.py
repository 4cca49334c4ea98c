"""The Python face, used as in a notebook; and what plugin authors import."""

import builtins
import doctest
import importlib
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import bench
import bench.model
from bench.experiment import by_name, config, grid
from bench.report.text import number

TINY = {
    "backends": ["numpy"],
    "samples": 8,
    "repeats": 4,
    "workers": 0,
    "timing": False,
    "reference": {"samples": 4096},
}


def cells(*words, **overrides):
    """The cells that :func:`bench.run` would run."""
    return grid.cells(config.load(words, settings=overrides))


# ---------------------------------------------------------------------------------------------------- a notebook


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A folder whose name a shell or Hydra would take apart."""
    return tmp_path_factory.mktemp("my results, [v1]")


@pytest.fixture(scope="module")
def rows(results):
    return bench.run(
        name="notes",
        scenes=["quadratic"],
        estimators=["fobg", "reinforce[baseline=none]"],
        results_dir=results,
        sweep={"sigma": np.array([0.1, 0.2]), "condition": [np.float64(10.0), np.int64(100)]},
        scene={"quadratic": {"dimension": 3}},
        **TINY,
    )


def test_run_returns_a_row_per_cell_and_writes_everything(rows, results):
    assert len(rows) == 8
    assert set(rows["status"]) == {"ok"}
    assert sorted(set(rows["condition"])) == [10.0, 100.0]
    assert sorted(set(rows["sigma"])) == [0.1, 0.2]
    assert set(rows["estimator_params"]) == {"", "baseline=none"}
    assert set(rows["dim"]) == {3.0}
    names = {path.name for path in (results / "notes").iterdir()}
    assert {"rows.parquet", "bias_variance.csv", "bias_variance.md", "report.html", "run.json"} <= names
    told = json.loads((results / "notes" / "run.json").read_text())
    assert 'scene={"quadratic":{"dimension":3}}' in told["argv"]
    assert told["config"]["sweep"] == {"sigma": [0.1, 0.2], "condition": [10.0, 100]}


def test_load_gives_the_same_rows_with_a_number_for_every_swept_axis(rows, results):
    found = bench.load(results / "notes")
    assert len(found) == len(rows)
    for name in ("condition", "sigma"):
        assert found[name].dtype == np.float64
        assert list(found[name]) == list(rows[name])
    assert list(found["key"]) == list(rows["key"])
    told = [json.loads(text) for text in found["parameters"]]
    assert [one["scene"]["condition"] for one in told] == list(found["condition"])
    assert set(found["study"]) == {"bias_variance"}
    ratio = found.pivot_table(index="condition", columns="estimator", values="variance")
    assert (ratio["reinforce"] > ratio["fobg"]).all()


def test_run_returns_its_own_rows_and_load_all_that_are_stored(rows, results):
    again = bench.run(
        name="notes", scenes=["quadratic"], estimators=["fobg"], results_dir=results, sweep={"sigma": [0.3]}, **TINY
    )
    assert len(again) == 1
    assert len(bench.load(results / "notes")) == len(rows) + 1


def test_problem_and_estimate():
    problem = bench.problem("quadratic[dimension=3]", backend="numpy")
    theta = problem.program.theta0
    w = np.zeros((problem.program.n_noise, 2))
    assert problem.value(theta, w).shape == (2,)
    assert problem.grad(theta, w).shape == (3, 2)
    found = bench.estimate(problem, "fobg", samples=16, repeats=8, seed=1, reference_samples=4096)
    assert found.values.shape == (8, 3)
    assert found.reference_method.startswith("closed_form")
    np.testing.assert_allclose(found.values.mean(axis=0), found.reference, rtol=0.5)
    assert found.as_dict()["bias_low"] <= found.as_dict()["bias_high"]
    assert str(found).startswith("fobg on quadratic[dimension=3], numpy: 8 estimates of 16 samples\nrelative bias ")


def test_a_problem_takes_lists_and_one_sample():
    problem = bench.problem("quadratic[dimension=3]", backend="numpy")
    w = np.arange(6.0).reshape(3, 2) / 10
    theta = [1.0, -2.0, 0.5]
    many = problem.grad(theta, w)
    np.testing.assert_array_equal(problem.grad(theta, w[:, 1].tolist()), many[:, 1])
    np.testing.assert_array_equal(problem.score(theta, list(w[:, 1])), problem.score(theta, w)[:, 1])
    assert problem.value(theta, [0.0, 0.1, 0.2]).shape == ()
    assert problem.value(np.tile(np.array(theta)[:, None], 4)).shape == (4,)
    np.testing.assert_array_equal(problem.grad(), problem.grad(problem.program.theta0, np.zeros((3, 1)))[:, 0])
    for function in (problem.value, problem.grad, problem.score):
        with pytest.raises(bench.UserError, match=r"noise w has the shape \(2,\): give \(3,\) or \(3, B\)"):
            function(theta, [0.0, 0.1])
        with pytest.raises(bench.UserError, match=r"theta has the shape \(\): give \(3,\) or \(3, B\)"):
            function(0.1, [0.0, 0.1, 0.2])


def test_an_estimate_of_a_gradient_of_0_is_printed_without_division():
    found = bench.estimate(
        bench.problem("quadratic[dimension=2]", backend="numpy", theta0=[0.0, 0.0]),
        "fobg",
        samples=8,
        repeats=8,
        reference_samples=4096,
    )
    assert np.isnan(found.summary.rmse_rel)
    facts = found._facts()
    assert facts["RMSE"].split()[0] == number(found.summary.rmse, 3)
    assert "bias" in facts
    assert "nan" not in str(found)


def test_a_notebook_shows_problems_estimates_and_reports():
    problem = bench.problem("pushing[horizon=3]", contact="penalty[stiffness=500]", backend="numpy", theta=["mass"])
    found = bench.estimate(problem, "fobg", samples=4, repeats=3, reference_samples=512, tolerance=0.5)
    report = bench.examine(lambda x: x[0] ** 2, [1.0], grad=lambda x: 2 * x, progress=False, budget=5)
    assert repr(problem) == (
        "Problem: pushing[horizon=3], penalty[stiffness=500], semi_implicit_euler, numpy; "
        "theta = [0.1], d = 1; noise: sigma = 0.3 on theta, n_w = 1"
    )
    assert list(found.to_frame().index) == ["mass"]
    parameters = problem.to_frame().set_index(["part", "parameter"])
    assert parameters.loc[("contact", "stiffness"), "value"] == 500
    assert report.frame["name"].iloc[0] == "theta[0]"


def test_list_has_a_row_per_plugin():
    table = bench.list("fobg", "integrators")
    assert set(table["kind"]) == {"estimators", "integrators"}
    fobg = table[table["name"] == "fobg"].iloc[0]
    assert fobg["available"]
    assert "needs grad" in fobg["description"]
    everything = bench.list().set_index(["kind", "name"])
    assert everything.loc[("contacts", "penalty"), "parameters"]["stiffness"] == "1000"
    with pytest.raises(bench.UserError, match="did you mean 'fobg'"):
        bench.list("fbog")


def test_compare_finds_what_got_worse(rows, results, tmp_path):
    (tmp_path / "notes").mkdir()
    stored = pd.read_parquet(results / "notes" / "rows.parquet")
    doubled = stored.assign(mean_estimate=stored["mean_estimate"] * 2)
    doubled.to_parquet(tmp_path / "notes" / "rows.parquet")
    comparison = bench.compare(results, tmp_path)
    assert comparison.worse
    assert (comparison.to_frame()["outcome"] == "worse").any()
    assert " worse in: " in repr(comparison)
    assert not bench.compare(results, results).worse


def test_estimate_is_that_of_a_cell(rows):
    cell = rows[(rows["estimator"] == "fobg") & (rows["sigma"] == 0.1) & (rows["condition"] == 10.0)].iloc[0]
    problem = bench.problem("quadratic[dimension=3]", backend="numpy")
    found = bench.estimate(problem, "fobg", samples=8, repeats=4, seed=0, reference_samples=4096).as_dict()
    for name in ("bias", "variance", "rmse"):
        assert found[name] == pytest.approx(cell[name], rel=1e-9)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: bench.run("stiffness_swep"), "did you mean 'stiffness_sweep'"),
        (lambda: bench.run(sampels=8), "did you mean 'samples'"),
        (lambda: bench.problem("quadratc"), "did you mean 'quadratic'"),
        (lambda: bench.estimate(bench.problem("quadratic", backend="numpy"), "fob"), "did you mean 'fobg'"),
        (lambda: bench.load("no_such_folder"), "no rows are stored in 'no_such_folder'"),
    ],
)
def test_bad_names_are_told_with_the_nearest_one(call, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(bench.UserError, match=said):
        call()


def test_a_plugin_without_its_library_is_named(monkeypatch):
    entry = SimpleNamespace(plugin=object, reason="not installed: jax; pip install jax")
    monkeypatch.setattr(by_name.registry, "find", lambda *_: entry)
    with pytest.raises(bench.Unsupported, match="scene 'heaviside' is not installed: jax; pip install jax"):
        bench.problem("heaviside", backend="numpy")


def test_what_cannot_work_is_unsupported():
    with pytest.raises(bench.Unsupported):
        bench.problem("pushing", contact="complementarity", backend="numpy")


# ------------------------------------------------------------------------------------------------------ keywords


def test_keywords_are_the_settings_of_the_command_line():
    same = [
        (
            ["samples=8", "sweep.stiffness=[100,1e4]"],
            {"samples": np.int64(8), "sweep": {"stiffness": np.array([100, 1e4])}},
        ),
        (["estimators=[reinforce[baseline=none]]"], {"estimators": "reinforce[baseline=none]"}),
        (["study=bias_variance[timed_calls=3]"], {"study": "bias_variance[timed_calls=3]"}),
        (["theta=[mass]", "theta0=[0.3]"], {"theta": ("mass",), "theta0": np.array([0.3])}),
        (
            ["sweep.bound=[null,1.0]", "estimators=[alpha_order]"],
            {"sweep": {"bound": [None, 1.0]}, "estimators": ["alpha_order"]},
        ),
    ]
    for words, settings in same:
        assert [cell.key for cell in cells(*words)] == [cell.key for cell in cells(**settings)], settings


@pytest.mark.parametrize("text", ["what, if: anything [x] 'quoted' {a}? \\ b\\' c\\", "ünï ${x} #1"])
def test_texts_come_through_as_they_are(text):
    made = config.load([], settings={"question": text, "results_dir": Path(f"/{text}")})
    assert made.question == text
    assert made.results_dir == Path(f"/{text}")


def test_marks_are_a_table_with_names_of_any_kind():
    marks = {"stiffness": {"step size limit": 6400, "a: (b), [c]=1": 2}}
    words = ["contacts=[penalty]", "scenes=[pushing]", "sweep.stiffness=[1e3]"]
    assert config.load(words, settings={"marks": marks}).marks == marks


# -------------------------------------------------------------------------------------------------- public names


def test_bench_has_a_dozen_names_and_every_contract_is_in_bench_plugin():
    assert len(dir(bench)) <= 13
    assert set(dir(bench)) == {*bench.__all__, "list", "__version__"}
    for name in dir(bench):
        assert getattr(bench, name) is not None
    assert len(bench.plugin.__all__) == len(set(bench.plugin.__all__))
    assert set(bench.model.__all__) < set(bench.plugin.__all__)
    for name in bench.model.__all__:
        assert getattr(bench.plugin, name) is getattr(bench.model, name)


def test_a_star_import_replaces_no_builtin():
    names: dict[str, object] = {}
    exec("from bench import *", names)
    assert names["run"] is bench.run
    assert not set(names) & set(dir(builtins)) - {"__builtins__"}


@pytest.mark.parametrize(
    "name",
    ["host.parameters", "host.identity", "report.text", "report.names", "experiment.grid", "errors", "claims.claim"],
)
def test_examples_in_docstrings(name):
    done = doctest.testmod(importlib.import_module(f"bench.{name}"))
    assert done.attempted > 0
    assert done.failed == 0


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"plugins": ""}, "must be folders"),
        ({"plugins": 3}, "must be folders"),
        ({"scene": {("a",): 1}}, "keys must be"),
        ({"scene": {np.int64(1): 2}}, "keys must be"),
    ],
)
def test_settings_of_python_that_cannot_be_read_are_named(settings, told):
    with pytest.raises(bench.UserError, match=told):
        bench.run(name="mine", **settings)
