"""Simulators that others wrote: their files, the stored reports and the page, and those whose packages `[all]` installs."""

import json

import pytest

from examples.atlas import __main__ as atlas

LINES = 40
SLOW = ("scipy_ode", "optimistix_root", "mjx_ball")
FACTS = {name: atlas.about(name) for name in atlas.names()}
HERE = [
    pytest.param(n, marks=pytest.mark.slow if n in SLOW else ()) for n, f in FACTS.items() if f["python"] == "bench"
]


@pytest.mark.parametrize("name", FACTS)
def test_a_simulator_is_short_and_its_demanded_answer_is_that_of_its_truth(name):
    facts, row = FACTS[name], json.loads((atlas.REPORTS / f"{name}.json").read_text())
    assert facts.keys() - {"use", "jumps", "advice"} == {
        *["name", "what", "package", "python", "requires", "examine", "derivative", "how"]
    }
    lines = [line for line in (atlas.FOLDER / f"{name}.py").read_text().splitlines() if line]
    assert len(lines) <= LINES
    assert atlas.agreement(facts, row) in ("agrees", "open", "FALSE ALARM")


def test_the_page_is_that_of_the_reports():
    assert atlas.PAGE.read_text() == atlas.page()


@pytest.mark.parametrize("name", HERE)
def test_an_installed_simulator_gets_the_answer_that_its_truth_demands(name, tmp_path, monkeypatch):
    monkeypatch.setattr(atlas, "REPORTS", tmp_path)
    row = atlas.examine(name)
    if row["derivative"] == "unavailable":
        pytest.skip(row["reason"])
    assert atlas.agreement(FACTS[name], row) == "agrees", row


def test_a_package_without_its_python_is_unavailable(tmp_path, monkeypatch):
    monkeypatch.setattr(atlas, "REPORTS", tmp_path)
    monkeypatch.setenv("BENCH_ENGINES", str(tmp_path))
    assert atlas.examine("pymunk_slide")["derivative"] == "unavailable"


@pytest.mark.parametrize(
    ("demanded", "reported", "off", "word"),
    [
        ("right", "wrong", 0.0, "FALSE ALARM"),
        ("wrong", "right", None, "MISSED"),
        ("right", "not shown", 0.0, "open"),
        ("wrong", "wrong", 0.1, "agrees"),
        ("right", "right", 0.1, "TRUTH DIFFERS"),
    ],
)
def test_answers_are_compared_with_the_truth(demanded, reported, off, word):
    assert atlas.agreement({"derivative": demanded}, {"derivative": reported, "off": off}) == word
