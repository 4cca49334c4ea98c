"""A table on the terminal is never wider than the terminal, and states what it leaves out."""

import io

import numpy as np
import pandas as pd
import pytest
from helpers import experiment, stored
from rich.cells import cell_len
from rich.console import Console

from bench.experiment.columns import interval
from bench.experiment.views import Table, Views
from bench.report import finish, terminal, writer

LONG = "alpha_order[delta=0.95,gamma=4,sharing=shared]"
WORDS = ["fobg", LONG, "a text with blanks", "x" * 50, "名前が長い", "", "line one\nline two", "1.2 [1.0, 1.4]"]


def printed(table, width, title="", **given):
    """The lines that a console of this width shows, without blanks at their ends."""
    out = io.StringIO()
    terminal.print_table(Console(file=out, width=width), table, title, **given)
    return [line.rstrip() for line in out.getvalue().splitlines()]


@pytest.mark.parametrize("seed", range(12))
def test_no_line_is_wider_than_asked(seed):
    random = np.random.default_rng(seed)
    columns = {
        f"column {index} {'long ' * int(random.integers(4))}": random.choice(WORDS, 5)
        for index in range(random.integers(1, 14))
    }
    table = pd.DataFrame(columns)
    right = [name for name in table if random.random() < 0.3]
    for width in (20, 33, 60, 80, 140):
        assert max(map(cell_len, printed(table, width, "a title " * 5, right=right))) <= width


def test_nothing_is_lost_where_there_is_room():
    table = pd.DataFrame({"estimator": ["fobg", LONG], "rel. RMSE": ["0.0213", "1.20e4"], "samples": ["16", "256"]})
    assert printed(table, 80, "Errors", right=["rel. RMSE", "samples"]) == [
        "Errors",
        f"{'estimator':46}  rel. RMSE  samples",
        f"{'fobg':46}     0.0213       16",
        f"{LONG}     1.20e4      256",
    ]


def test_constant_columns_are_stated_once_and_others_left_out_from_the_right():
    table = pd.DataFrame(
        {"scene": ["one", "two"], "contact": ["penalty"] * 2, "bias": ["0.1 [0.0, 0.2]", "0.2 [0.1, 0.3]"]}
        | {"extra": ["a" * 30, "b" * 30], "time": ["1 ms", "2 ms"], "status": ["ok", "error"]}
    )
    right = ["bias", "extra", "time"]
    lines = printed(table, 40, right=right)
    assert lines[0] == "contact: penalty"
    assert lines[1].split() == ["scene", "bias", "status"]
    assert "Left out to fit 40 characters: extra, time." in " ".join(lines)


def test_numbers_stay_whole_and_texts_break_at_blanks():
    table = pd.DataFrame({"a text": ["word " * 12, "x" * 40], "number": ["123.456789", "1"]})
    lines = printed(table, 36, right=["number"])
    assert lines[0].split() == ["a", "text", "number"]
    assert lines[1].endswith("word  123.456789")
    assert len(lines) == 6


def test_a_missing_text_is_blank_and_two_columns_of_one_name_are_both_shown():
    table = pd.DataFrame([["a", "1", None]], columns=["name", "value", "value"])
    assert printed(table, 80, right=["value"]) == ["name  value  value", "a         1"]
    assert len(printed(table[:0], 80)) == 1


def test_columns_of_the_environment_count_in_a_pipe(monkeypatch):
    monkeypatch.setenv("COLUMNS", "57")
    assert terminal.open_console().width == 57
    out = io.StringIO()
    console = Console(file=out, width=40)
    terminal.print_table(console, pd.DataFrame({"a[b]": ["[red]x[/red]" * 5]}), title="[bold]t")
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= 40
    assert "[red]" in out.getvalue() or "[red" in out.getvalue()


def test_a_pipe_is_as_wide_as_its_table_and_omitted_intervals_are_said(monkeypatch, capsys):
    """Intervals were dropped in silence."""
    frame = pd.DataFrame({f"x{i}{end}": [1.23e-5] for i in range(9) for end in ("", "_low", "_high")})
    one = Table("one", frame, [interval(f"x{i}") for i in range(9)], terminal=True)
    rows = pd.DataFrame({"status": ["ok"]})
    shown = {}
    for width in ("80", None):
        monkeypatch.delenv("COLUMNS", raising=False)
        if width:
            monkeypatch.setenv("COLUMNS", width)
        writer.show(experiment(), rows, Views([one]))
        shown[width] = capsys.readouterr().out
    assert "Left out to fit 80 characters: 95% intervals" in " ".join(shown["80"].split())
    assert shown[None].count("[1.2e-5, 1.2e-5]") == 9
    assert "Left out" not in shown[None]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["quick", "identify"])
def test_what_a_command_prints_of_standard_results_fits(name, monkeypatch, capsys):
    given, rows = stored(name)
    monkeypatch.setenv("COLUMNS", "40")
    writer.show(given, rows, finish.views_of(given, rows))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(cell_len, lines)) <= 40
    for said in (
        given.question,
        f"{len(rows)} cells:",
        *(f"{n} {s}" for s, n in rows["status"].value_counts().items()),
    ):
        assert said in " ".join(" ".join(lines).split())
