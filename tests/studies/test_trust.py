"""The rule of when to trust a gradient: it is counted as it says."""

import json

import pandas as pd
from bench.plugins.studies.bias_variance import trust
from helpers import row, table


def rows():
    """Right with little spread, wrong with much, wrong with none (the mean is 0), and right with a remark."""
    made = table([row(seed=i) for i in range(4)])
    return made.assign(
        rmse_rel=[0.1, 2.0, 1.0, 0.2],
        grad_norm=[1.0, 1.0, 0.0, 1.0],
        variance=[0.01, 4.0, 0.0, 0.04],
        bias=[0.0, 0.0, 1.0, 0.0],
        reference_norm=1.0,
        reason=["", "", "", "heavy tails"],
    )


def test_the_rule_counts_what_it_trusts_and_what_it_holds_back():
    found = trust.counts(rows().assign(variance=[0.01, 4.0, 0.0, 0.36]))
    assert found == {"cells": 4, "trusted": 1, "wrong": 0, "others": 3, "missed": 1}


def test_trusted_is_said_of_the_checked_program_at_the_same_theta_and_backend(tmp_path):
    made = rows().assign(parameters=lambda frame: [parameters(sigma) for sigma in (0.1, 0.2, 0.3, 0.4)])
    checked = pd.DataFrame(
        {"parameters": [parameters(0.4), parameters(0.4), parameters(0.1)], "untrusted": [1.0, 0.0, 0.0]}
    )
    (tmp_path / "gradcheck").mkdir()
    checked.to_parquet(tmp_path / "gradcheck" / "rows.parquet")
    answers = trust.trusted(tmp_path, made)
    assert answers.tolist() == ["yes", "no", "no", "no"]
    assert trust.headline(answers) == "trusted: fobg 1 yes, 3 no"
    for changed in (
        parameters(0.1, backend="torch"),
        parameters(0.1, theta={"names": [], "at": [1.0]}),
        parameters(0.5),
    ):
        answers = trust.trusted(tmp_path, made.iloc[:1].assign(parameters=changed))
        assert answers.tolist() == ["not checked"]
    assert trust.headline(answers) == "trusted: fobg 1 not checked (to check: python -m bench gradcheck SCENE)"
    assert set(trust.trusted(tmp_path, made.assign(estimator="reinforce"))) == {""}


def parameters(sigma, backend="jax", theta=None):
    """The parameters of a row, as JSON."""
    plugins = {
        "scene": {"name": "pushing", "sigma": sigma},
        "backend": {"name": backend},
        "estimator": {"name": "fobg"},
    }
    return json.dumps(plugins | {"contact": None, "integrator": None, "theta": theta})


def test_only_cells_with_an_error_of_the_estimators_asked_for_count(tmp_path, capsys):
    given = pd.concat([rows(), rows().assign(status="error"), rows().assign(estimator="reinforce")])
    for name, kept in (("one", given), ("two", given.drop(columns="rmse_rel"))):
        (tmp_path / name).mkdir()
        kept.to_parquet(tmp_path / name / "rows.parquet")
    trust.main([str(tmp_path)])
    out = "fobg: the spread trusts 2 of 4 cells, 0 of them wrong; of the 2 others 0 are right\n"
    assert capsys.readouterr().out == out
