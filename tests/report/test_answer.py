"""Answers: references to tables are filled in, their conditions are checked, and other settings have none."""

import math

import pandas as pd
import pytest

from bench.errors import UserError
from bench.experiment import config
from bench.report.answer import fill, value_of

TABLE = pd.DataFrame(
    {
        "method": ["fobg", "fobg", "smooth, wide", "smooth, wide"],
        "at": [10.0, 1000.0, 10.0, 1000.0],
        "error": [0.1, 0.152, 0.5, math.nan],
        "error_low": [0.09, 0.14, 0.4, math.nan],
        "error_high": [0.11, 0.16, math.inf, math.nan],
        "verdict": ["works", "works", "open", "no result"],
    }
)


def filled(reference):
    return value_of(reference, {"errors": TABLE}.__getitem__)


@pytest.mark.parametrize(
    ("reference", "text"),
    [
        ("errors | method=fobg | error", "0.10 to 0.15"),
        ("errors | method=fobg, at<=100 | error", "0.10"),
        ("errors | method=fobg | error < 1", "0.10 to 0.15"),
        ("errors | method=fobg | error, verdict=works | most", "0.15"),
        ('errors | method="smooth, wide", at=1e1 | error | interval', "0.500 [0.400, no limit]"),
        ("errors | method=fobg, at=10 | error | percent", "10%"),
        ("errors | verdict!=works | method | rows", "2"),
        ("errors | | method | names", "fobg and smooth, wide"),
        ("errors | at>10, verdict=works | at | integer", "1,000"),
    ],
)
def test_a_reference_gives_the_values_of_its_rows(reference, text):
    assert filled(reference) == text


@pytest.mark.parametrize(
    ("reference", "error"),
    [
        ("errors | method=fobg | error < 0.12", "error is 0.152"),
        ("errors | at=10 | error, verdict=works", "verdict is open"),
        ("errors | method=gone | error", "no rows with method=gone"),
        ("errors | at=1000 | error", "error is not finite"),
        ("errors | method=fobg | error | interval", "an interval belongs to one row, and 2 are selected"),
    ],
)
def test_an_answer_that_the_rows_do_not_carry_is_an_error(reference, error):
    with pytest.raises(LookupError, match=error):
        filled(reference)


@pytest.mark.parametrize(
    "reference", ["errors | metod=fobg | error", "errors | | eror", "errors | | error | hex", "errors | fobg | error"]
)
def test_a_reference_that_names_nothing_is_refused(reference):
    with pytest.raises(UserError, match=r"did you mean|unknown|is not a filter"):
        filled(reference)


def test_a_text_keeps_its_words():
    assert fill("It has {errors | method=fobg | error}.", {"errors": TABLE}.__getitem__) == "It has 0.10 to 0.15."


def test_an_answer_holds_for_the_settings_of_its_file_only(tmp_path):
    """Where results are stored and how they are drawn does not matter, a value of the sweep does."""
    words = [
        "experiment=stiffness_sweep",
        f"results_dir={tmp_path}",
        "name=again",
        "formats=[]",
        "workers=1",
    ]
    assert config.load(words).answer == config.load(words[:1]).answer != ""
    assert config.load([*words, f"samples={config.load(words).samples}"]).answer
    assert not config.load([*words, "sweep.sigma=[0.2]"]).answer
    assert not config.load([*words, "seed=1"]).answer


def test_an_experiment_does_not_inherit_an_answer(tmp_path):
    (tmp_path / "experiment").mkdir()
    text = "# @package _global_\ndefaults: [stiffness_sweep, _self_]\nname: mine\n"
    (tmp_path / "experiment" / "mine.yaml").write_text(text)
    assert not config.load(["experiment=mine"], [tmp_path]).answer
