"""The rule of when to trust a gradient: it is counted as it says."""

import pandas as pd
from bench.plugins.studies.bias_variance import trust
from helpers import row, table


def rows():
    """Right with little spread, wrong with much, wrong with none (the mean is 0), and right with a remark."""
    made = table([row(seed=i) for i in range(4)])
    return made.assign(
        rmse_rel=[0.1, 2.0, 1.0, 0.2], grad_norm=[1.0, 1.0, 0.0, 1.0], variance=[0.01, 4.0, 0.0, 0.04],
        bias=[0.0, 0.0, 1.0, 0.0], reference_norm=1.0, reason=["", "", "", "heavy tails"],
    )  # fmt: skip


def test_rules_count_what_they_pass_and_what_they_hold_back():
    found = trust.score_rules(rows()).set_index("rule")
    counts = ["trusted", "of those wrong", "right ones not trusted"]
    assert found[counts].to_numpy().tolist() == [[4, 2, 0], [3, 2, 1], [2, 0, 0], [1, 0, 1]]


def test_only_cells_with_an_error_of_the_estimators_asked_for_count(tmp_path, capsys):
    given = pd.concat([rows(), rows().assign(status="error"), rows().assign(estimator="reinforce")])
    for name, kept in (("one", given), ("two", given.drop(columns="rmse_rel"))):
        (tmp_path / name).mkdir()
        kept.to_parquet(tmp_path / name / "rows.parquet")
    trust.main([str(tmp_path)])
    assert capsys.readouterr().out.startswith("fobg: 4 cells, 2 wrong by 0.5 of the gradient or more")
