"""Configurations that nobody would write: each gives rows, or exit status 2 with a reason on one line."""

import tempfile
from pathlib import Path

import pytest
from bench.plugins.studies.bias_variance.columns import COLUMNS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bench.cli import main
from bench.run.store import Store

BASE = [
    "scenes=[heaviside]",
    "estimators=[fobg]",
    "backends=[numpy]",
    "samples=4",
    "repeats=3",
    "workers=0",
    "reference.samples=4096",
    "name=fuzz",
    "--quiet",
]
odd = st.sampled_from(
    [
        "",
        "null",
        "~",
        "0",
        "-0.0",
        "-1",
        "1e400",
        "nan",
        "inf",
        "1e-320",
        "0x10",
        "1_0",
        "true",
        "'1'",
        "[]",
        "{}",
        "[1,2]",
        "{a: 1}",
        "[[1]]",
        "[null]",
        "${name}",
        "../../x",
        "/etc/passwd",
        "a b",
        "ünï",
        "$(id)",
        "<b>",
        "%s",
        "!!python/object:os.system",
        "{_target_: os.system}",
        "1" * 400,
        "\\",
        "'",
        "=",
        "a=b",
        "#",
        "|",
        "fobg[x=1]",
        "heaviside[sigma=0.2]",
    ]
)
value = st.one_of(odd, st.floats(1e-3, 1e3).map(repr), st.integers(-5, 40).map(str), st.text(max_size=12))
setting = st.sampled_from(
    [
        "samples",
        "repeats",
        "seed",
        "study",
        "timing",
        "timeout",
        "memory",
        "on_error",
        "versions",
        "retry",
        "marks",
        "name",
        "reference",
        "reference.samples",
        "sweep",
        "sweep.sigma",
        "sweep.samples",
        "sweep.zip",
        "sweep.union",
        "sweep._target_",
        "scene",
        "scene.heaviside.sigma",
        "estimator.reinforce.baseline",
        "hydra.launcher",
        "+hydra.sweeper",
        "defaults",
        "+new",
        "~sweep",
        "experiment",
        "+experiment@x",
        "scenes",
        "estimators",
        "backends",
        "contacts",
    ]
)
word = st.one_of(st.builds("{}={}".format, setting, value), st.text(max_size=10))
words = st.lists(word, min_size=1, max_size=4).filter(
    # nothing asks for more samples than a test can pay
    lambda some: not any(len(one.partition("=")[2]) > 4 for one in some if "samples" in one or "repeats" in one)
)


@pytest.fixture(autouse=True)
def no_reports(monkeypatch):
    """Tables and charts of tiny runs, a thousand times over, would take most of the time."""
    monkeypatch.setattr("bench.report.finish.write", lambda experiment, rows: (None, []))
    monkeypatch.setattr("bench.report.writer.show", lambda experiment, rows, views: None)


def check(words, verb, capsys):
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder) / "in" / "out"
        status = main([verb, *BASE, *words, f"results_dir={where}"])
        said = capsys.readouterr().err.strip()
        assert status in (0, 1, 2)
        assert "Traceback" not in said
        if status == 2:
            assert said.startswith("bench: ")
            assert len(said.splitlines()) == 1
            assert "\x1b" not in said
        elif verb == "run":
            (store,) = (path for path in where.iterdir() if path.name != "references")
            assert len(Store(store, COLUMNS).load()) > 0
        assert not [path for path in Path(folder).rglob("*") if path.is_file() and where not in path.parents]


@pytest.mark.parametrize(
    "count", [pytest.param(20, marks=pytest.mark.slow), pytest.param(1000, marks=pytest.mark.full)]
)
def test_any_words_give_rows_or_a_reason(count, capsys):
    @settings(max_examples=count, deadline=None, derandomize=count < 1000, suppress_health_check=list(HealthCheck))
    @given(words=words, verb=st.sampled_from(["run", "plan"]))
    def found(words, verb):
        check(words, verb, capsys)

    found()
