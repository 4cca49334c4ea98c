"""Parameters of stored rows as typed columns, and the columns that make rows the same problem."""

import numpy as np
from helpers import loaded, rows_of

from bench.experiment.parameters import flatten, number_problems, problem_columns, swept_columns

WORDS = ("scenes=[pushing,quadratic]", "contacts=[penalty]", "backends=[numpy]", "estimators=[reinforce,alpha_order]")


def rows_with(*words):
    return rows_of(*loaded(*WORDS, *words))


def test_parameters_are_columns_with_their_type():
    rows = rows_with()
    table = flatten(rows)
    assert list(table.index) == list(rows.index)
    assert table["scene.name"].tolist() == ["pushing", "pushing", "quadratic", "quadratic"]
    assert table["scene.mass"].dtype == np.float64
    assert table["scene.mass"].tolist()[:2] == [0.1, 0.1]
    assert table["scene.mass"].isna().tolist() == [False, False, True, True]
    assert table["contact.damping_mode"].tolist()[0] == "clipped"
    assert flatten(rows.iloc[:0]).empty


def test_a_swept_name_means_the_parameter_of_the_plugins_that_it_names():
    table = flatten(rows_with())
    for name in ("delta", "alpha_order.delta", "estimator.delta", "estimator.alpha_order.delta"):
        ((column, mask),) = swept_columns(name, table).items()
        assert column == "estimator.delta"
        assert (mask & table[column].notna()).tolist() == [False, True, False, True], name
    assert not swept_columns("study.timed_calls", table)
    assert not any(
        mask.any() and table.loc[mask, c].notna().any() for c, mask in swept_columns("reinforce.delta", table).items()
    )


def test_a_problem_is_scene_law_integrator_study_and_theta_less_the_swept_names():
    rows = rows_with("sweep.mass=[0.1,0.2]")
    assert number_problems(rows).tolist() == [0, 0, 1, 1, 2, 2]
    assert number_problems(rows, without=["mass"]).tolist() == [0, 0, 1, 1, 0, 0]
    assert number_problems(rows, ["backend"]).nunique() == 1
    assert not any(column.startswith(("estimator.", "backend.")) for column in problem_columns(rows))
