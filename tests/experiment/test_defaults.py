"""A stored row that lacks a parameter was made with the present default."""

import json

import pytest
from helpers import loaded, rows_of

from bench.experiment.defaults import completed, completed_json, completed_rows

WORDS = ("scenes=[pushing]", "contacts=[penalty]", "estimators=[alpha_order]", "backends=[numpy]")


@pytest.fixture(scope="module")
def text():
    experiment, cells = loaded(*WORDS, "theta=[mass]")
    return rows_of(experiment, cells)["parameters"].iloc[0]


def without(text, axis, *names):
    given = json.loads(text)
    for name in names:
        del given[axis][name]
    return given


def test_parameters_that_are_all_there_stay_as_they_are(text):
    assert completed_json(text) == text


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
    import pandas as pd

    rows = pd.DataFrame({"parameters": [json.dumps(without(text, "scene", "hold")), text, "", "not JSON"]})
    assert completed_rows(rows)["parameters"].tolist() == [text, text, "", "not JSON"]
