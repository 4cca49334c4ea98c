"""Parameters of stored rows: today's defaults, what a name in a sweep refers to, and rows of the same problem."""

import json

import pandas as pd
import pytest
from helpers import loaded, rows_of
from hydra.core.override_parser.overrides_parser import OverridesParser

from bench.experiment import config
from bench.experiment.axes import Axis, values_of
from bench.experiment.overrides import parse
from bench.experiment.parameters import completed, completed_json, completed_rows, named, number_problems

WORDS = ("scenes=[pushing,quadratic]", "contacts=[penalty]", "backends=[numpy]", "estimators=[reinforce,alpha_order]")


def rows_with(*words):
    return rows_of(*loaded(*WORDS, *words))


@pytest.fixture(scope="module")
def text():
    return rows_with("theta=[mass]", "scenes=[pushing]", "estimators=[alpha_order]")["parameters"].iloc[0]


def without(text, axis, *names):
    given = json.loads(text)
    for name in names:
        del given[axis][name]
    return given


# ---------------------------------------------------------------------------------------------------------- defaults


@pytest.mark.parametrize(
    ("axis", "name"),
    [
        ("scene", "hold"),
        ("estimator", "gamma"),
        ("study", "timed_calls"),
        ("backend", "dtype"),
        ("theta", "at"),
        ("reference", "samples"),
    ],
)
def test_a_missing_parameter_is_its_present_default_in_its_declared_place(text, axis, name):
    assert completed_json(json.dumps(without(text, axis, name))) == text
    assert completed_json(text) == text


def test_a_missing_contact_parameter_is_the_value_of_the_scene(text):
    old = without(text, "contact", "stiffness")
    old["scene"] = {"name": "bouncing_ball"}
    assert completed(old)["contact"]["stiffness"] == 1e4
    old["scene"] = {"name": "no_such_scene", "mass": 2.0}
    assert completed(old)["contact"]["stiffness"] == 1e3  # the law's own
    assert completed(old)["scene"] == old["scene"]


def test_parameters_in_another_order_and_unknown_ones_are_kept(text):
    given = json.loads(text)
    given["scene"] = {"retired": 3, **dict(reversed(given["scene"].items()))}
    assert list(completed(given)["scene"]) == [*json.loads(text)["scene"], "retired"]


def test_rows_of_old_and_new_have_the_same_parameters(text):
    rows = pd.DataFrame({"parameters": [json.dumps(without(text, "scene", "hold")), text, "", "{}"]})
    assert completed_rows(rows)["parameters"].tolist() == [text, text, "", "{}"]


def test_rows_from_before_a_changed_default_are_labelled_by_todays():
    rows = rows_with("scenes=[pushing]", "estimators=[reinforce[baseline=center],reinforce]")
    rows = pd.concat([rows.assign(estimator_params=["", "baseline=leave_one_out"]), rows[:1].assign(parameters="")])
    assert list(completed_rows(rows)["estimator_params"]) == ["baseline=center", "", "baseline=center"]


# --------------------------------------------------------------------------------------------------- names of a sweep


@pytest.mark.parametrize("name", ["delta", "alpha_order.delta", "estimator.delta", "estimator.alpha_order.delta"])
def test_a_swept_name_means_the_parameter_of_the_plugins_that_it_names(name):
    rows = rows_with("scenes=[pushing]")
    found = named(rows, [name])
    assert [*found] == [("estimator", "alpha_order", "delta")]
    assert found.notna().any(axis=1).tolist() == [False, True]
    assert named(rows, ["study.timed_calls", "reinforce.delta", "name"]).empty


def test_the_values_of_an_axis_are_numbers():
    rows = rows_with()
    assert values_of(Axis("mass", ("mass",)), rows).tolist()[:2] == [0.1, 0.1]
    for name in ("quadratic.mass", "damping_mode"):
        assert pd.isna(values_of(Axis(name, (name,)), rows)).all()


# ------------------------------------------------------------------------------------------------------------ problems


def test_a_problem_is_scene_law_integrator_study_and_theta_less_the_swept_names():
    rows = rows_with("sweep.mass=[0.1,0.2]")
    assert number_problems(rows).tolist() == [0, 0, 1, 1, 2, 2]
    assert number_problems(rows, without=["mass"]).tolist() == [0, 0, 1, 1, 0, 0]
    assert number_problems(rows, ["backend"]).nunique() == 1


@pytest.mark.parametrize(
    "value", ["[1,-2,+3,0]", "[1.5, 2., .5,-1e3 ,1E-2, 0.0]", "[01,1_0,inf,-nan]", "[[1,2],'3',x]"]
)
def test_lists_of_numbers_are_read_as_by_hydras_grammar(value):
    word = f"sweep.sigma={value}"
    read = OverridesParser.create().parse_override(word).value()
    keys, found = parse(word, word)
    assert keys == ["sweep", "sigma"]
    assert repr(found) == repr(read)


def test_a_changed_experiment_file_is_read_again(tmp_path):
    (tmp_path / "experiment").mkdir()
    for seed in (1, 23):
        (tmp_path / "experiment" / "mine.yaml").write_text(f"# @package _global_\nname: mine\nseed: {seed}\n")
        assert config.load(["experiment=mine"], [tmp_path]).seed == seed
