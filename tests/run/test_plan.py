"""What ``plan`` reports of rows that older code has stored: their cells run again, and it says so."""

import json

import pytest

from bench.cli import main
from bench.experiment import config
from bench.run.execute import execute, store_of
from bench.run.plan import plan

WORDS = [
    "scenes=[heaviside]", "backends=[numpy]", "estimators=[fobg,alpha_order]", "samples=8", "repeats=4",
    "workers=0", "timing=false",
]  # fmt: skip


def older(rows, **without):
    """Rows as older code would have stored them: under other keys, and without some parameters of plugins."""
    result = []
    for row in rows.to_dict("records"):
        parameters = json.loads(row["parameters"])
        for axis, name in without.items():
            parameters[axis].pop(name, None)
        result.append(row | {"key": f"{row['key'][::-1]}x", "parameters": json.dumps(parameters)})
    return result


@pytest.fixture
def stored(tmp_path):
    """The words of a complete run, and its rows."""
    words = [*WORDS, f"results_dir={tmp_path / 'first'}", "--quiet"]
    assert main(words) == 0
    return store_of(config.load(words[:-1])).load()


def planned_after(rows, *words):
    experiment = config.load([*WORDS, *words])
    store = store_of(experiment)
    store.prepare()
    store.append(*[{k: v for k, v in row.items() if isinstance(v, str | float | int)} for row in rows])
    return plan(experiment, store)


@pytest.mark.slow
def test_cells_that_older_code_has_stored_run_again_and_are_counted(tmp_path, stored, capsys):
    items = planned_after(older(stored), f"results_dir={tmp_path}")
    assert [(item.stored, item.by_older_code, item.added) for item in items] == [(False, True, ())] * 2
    assert main(["plan", *WORDS, f"results_dir={tmp_path}"]) == 0
    assert "2 cells, 0 stored, 2 to run (2 stored by older code), 0 refused" in capsys.readouterr().out


def test_a_parameter_that_was_added_counts_as_its_default_and_is_named(tmp_path, stored, capsys):
    items = planned_after(older(stored, estimator="gamma", scene="sigma"), f"results_dir={tmp_path}")
    assert all(item.by_older_code for item in items)
    assert [item.added for item in items] == [("heaviside.sigma",), ("heaviside.sigma", "alpha_order.gamma")]
    assert main(["plan", *WORDS, f"results_dir={tmp_path}"]) == 0
    said = capsys.readouterr().out
    assert "2 to run (2 stored by older code, without alpha_order.gamma, heaviside.sigma)" in said


def test_a_cell_with_another_value_than_the_default_was_not_stored(tmp_path, stored):
    items = planned_after(older(stored, estimator="gamma"), f"results_dir={tmp_path}", "estimator.alpha_order.gamma=7")
    assert [item.by_older_code for item in items] == [True, False]


@pytest.mark.parametrize("word", ["samples=16", "seed=1", "timing=true"])
def test_other_counts_and_times_are_other_cells(tmp_path, stored, word):
    items = planned_after(older(stored), f"results_dir={tmp_path}", word)
    assert not any(item.by_older_code for item in items)


@pytest.mark.slow
def test_a_stored_cell_is_not_called_old_beside_its_older_row(tmp_path, stored, capsys):
    experiment = config.load([*WORDS, f"results_dir={tmp_path}"])
    execute(experiment)
    planned_after(older(stored), f"results_dir={tmp_path}")
    assert main(["plan", *WORDS, f"results_dir={tmp_path}"]) == 0
    assert "2 cells, 2 stored, 0 to run, 0 refused" in capsys.readouterr().out
