"""Configurations that nobody would write: each gives rows, or exit status 2 with a reason on one line."""

import tempfile
from pathlib import Path

import pytest
from bench.plugins.studies.bias_variance.columns import COLUMNS
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from bench.cli import main
from bench.run.store import Store

BASE = ["backends=[numpy]", "samples=4", "repeats=3", "workers=0", "reference.samples=4096", "name=fuzz", "--quiet"]

odd = st.sampled_from(
    ["", "null", "~", "0", "-0.0", "-1", "1e400", "nan", "inf", "1e-320", "0x10", "1_0", "true", "True", "'1'", "[]", "{}",
     "[1,2]", "{a: 1}", "[[1]]", "[null]", "${oc.env:HOME}", "${name}", "../../x", "/etc/passwd", "a b", "ünï", "$(id)",
     "<b>", "%s", "!!python/object:os.system", "{_target_: os.system}", "1" * 400, "[1,[2,[3]]]", "\\", "'", "=", "a=b", "#", "|"]
)  # fmt: skip
number = st.one_of(
    st.floats(allow_nan=True).map(repr), st.integers(-5, 40).map(str), st.floats(1e-3, 1e3).map(repr), odd
)
listed = st.lists(number, max_size=3).map(lambda values: f"[{','.join(values)}]")
value = st.one_of(number, listed, st.text(max_size=12))
setting = st.sampled_from(
    ["samples", "repeats", "seed", "study", "timing", "timeout", "memory", "on_error", "versions", "retry", "marks", "question",
     "name", "reference", "reference.samples", "reference.tolerance", "sweep", "sweep.sigma", "sweep.samples", "sweep.seed",
     "sweep.zip", "sweep.union", "sweep.product", "sweep.fobg.x", "sweep._target_", "scene", "scene.heaviside",
     "scene.heaviside.sigma", "scene.quadratic.sigma", "contact.penalty.stiffness", "estimator.reinforce.baseline",
     "estimator.alpha_order.gamma", "backend.numpy.dtype", "hydra.launcher", "hydra/job_logging", "+hydra.sweeper", "defaults",
     "_target_", "+new", "~sweep", "experiment", "+experiment@x", "scenes", "estimators", "backends", "integrators", "contacts"]
)  # fmt: skip
plugin = st.sampled_from(
    ["fobg", "reinforce", "reinforce[baseline=none]", "randomized_smoothing", "alpha_order[gamma=4]", "finite_difference",
     "reinforce[baseline=", "fobg[]", "fobg[x=1]", "[", "nobody", "fobg,fobg"]
)  # fmt: skip
scene = st.sampled_from(
    ["heaviside", "quadratic", "linear", "heaviside[sigma=0.2]", "soft_heaviside", "pushin", "constant"]
)
word = st.one_of(
    st.builds("{}={}".format, setting, value),
    st.lists(plugin, max_size=2).map(lambda names: f"estimators=[{','.join(names)}]"),
    st.lists(scene, max_size=2).map(lambda names: f"scenes=[{','.join(names)}]"),
    st.text(max_size=10),
)
FEW = ["samples", "repeats", "sweep.samples"]


def affordable(words):
    """Whether nothing asks for more samples than a test can pay."""
    sizes = [w for w in words if w.partition("=")[0].lstrip("+") in FEW]
    return not any(len(piece) > 4 for w in sizes for piece in w.partition("=")[2].strip("[]").split(","))


def outcome(words, verb, where):
    return main([verb, "scenes=[heaviside]", "estimators=[fobg]", *BASE, *words, f"results_dir={where}"])


def check(words, verb, capsys):
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder) / "in" / "out"
        status = outcome(words, verb, where)
        said = capsys.readouterr().err.strip()
        assert status in (0, 1, 2)
        assert "Traceback" not in said
        if status == 2:
            assert said.startswith("bench: ")
            assert len(said.splitlines()) == 1
            assert "\x1b" not in said
        elif verb == "run":
            stores = [path for path in where.iterdir() if path.name != "references"]
            assert len(stores) == 1
            assert len(Store(stores[0], COLUMNS).load()) > 0
        assert not [path for path in Path(folder).rglob("*") if path.is_file() and where not in path.parents]


@pytest.fixture(autouse=True)
def no_reports(monkeypatch):
    """Tables and charts of tiny runs, a thousand times over, would take most of the time."""
    monkeypatch.setattr("bench.report.finish.write", lambda experiment, rows: (None, []))
    monkeypatch.setattr("bench.report.writer.show", lambda experiment, rows, views: None)


@pytest.mark.slow
@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(words=st.lists(word, min_size=1, max_size=4).filter(affordable), verb=st.sampled_from(["run", "plan"]))
@example(words=["name=../../x"], verb="run")
@example(words=["name=.."], verb="run")
@example(words=["sweep.sigma=[[1]]"], verb="run")
@example(words=["seed=99999999999999999999999"], verb="run")
@example(words=["marks={_target_: os.system}"], verb="run")
@example(words=["scene.heaviside._target_=os.system"], verb="run")
def test_a_few_configurations(words, verb, capsys):
    check(words, verb, capsys)


@pytest.mark.full
@settings(max_examples=1000, deadline=None, suppress_health_check=list(HealthCheck))
@given(words=st.lists(word, min_size=1, max_size=4).filter(affordable), verb=st.sampled_from(["run", "plan"]))
def test_a_thousand_configurations(words, verb, capsys):
    check(words, verb, capsys)
