"""For CI: exit statuses, baselines and the fixture."""

import json

import pytest

import bench
from bench import cli
from bench.errors import UserError

QUICK = {"progress": False, "calls": 400}


def cost(x):
    return x[0] ** 2 * x[1]


def grad(x, factor=1.0):
    return [factor * 2 * x[0] * x[1], factor * x[0] ** 2]


def examined(factor=1.0, **settings):
    return bench.examine(cost, [1.0, 0.5], grad=lambda x: grad(x, factor), **{**QUICK, **settings})


@pytest.fixture
def sim(tmp_path):
    path = tmp_path / "sim.py"
    path.write_text(
        "theta = [1.0, 0.5]\n"
        "def cost(x): return x[0] ** 2 * x[1]\n"
        "def kinked(x): return abs(x[0] - 1.0) + x[1]\n"
        "def nothing(x): return 2.0\n"
        "def right(x): return [2 * x[0] * x[1], x[0] ** 2]\n"
        "def off(x): return [2.2 * x[0] * x[1], x[0] ** 2]\n"
        "def side(x): return [0.0 if x[0] == 1 else 1.0 if x[0] > 1 else -1.0, 1.0]\n"
        "def zero(x): return [0.0, 0.0]\n"
    )
    return path


def run(*words):
    return cli.main(["examine", *map(str, words), "--quiet"])


def test_exit_statuses(sim, capsys):
    assert run(f"{sim}:cost", "grad=right", "calls=300") == 0
    assert run(f"{sim}:cost", "grad=off", "calls=300") == 1
    assert run(f"{sim}:cost", "grad=right", "calls=3") == 3
    assert run(f"{sim}:cost", "calls=300") == 0
    assert run(f"{sim}:nothing", "grad=zero", "calls=300") == 3
    assert run(f"{sim}:nothing", "grad=zero", "calls=300", "allow_zero=true") == 0
    assert run(f"{sim}:cost", "grad=wrong") == 2
    assert run(f"{sim}:kinked", "grad=side", "calls=1000") == 1
    assert run(f"{sim}:kinked", "grad=side", "calls=1000", "expect=kink") == 0
    out = capsys.readouterr()
    assert "expect=kink holds" in out.out
    assert f"next: choose a theta beside it\n  python -m bench examine {sim}:kinked grad=side" in out.out


@pytest.mark.parametrize(
    ("error", "said"),
    [("BaseException('no')", "cannot be imported: "), ("SystemExit(0)", "ends the process when it is")],
)
def test_a_file_that_raises_at_its_import_is_bad_input(tmp_path, capsys, error, said):
    (tmp_path / "raises.py").write_text(f"raise {error}\n")
    assert run(f"{tmp_path / 'raises.py'}:cost") == 2
    assert said in capsys.readouterr().err


def test_settings_of_the_command_line(sim, capsys):
    settings = ["tolerance=theta[0]:0.3", "atol=1e-9", "compile_budget=5s", "refined=cost"]
    assert run(f"{sim}:cost", "grad=off", "calls=400", *settings) == 0
    assert "small error, within the tolerance" in capsys.readouterr().out
    assert run(f"{sim}:cost", "expect=nonsense") == 2
    assert run(f"{sim}:cost", "expect=nondeterministic") == 2  # which cannot hold
    assert run(f"{sim}:cost", "tolerance=1,2,3") == 2


# -------------------------------------------------------------------------------------------- baseline


def test_a_baseline_accepts_what_was_there_and_refuses_what_is_worse(tmp_path):
    path = tmp_path / "baseline.json"
    assert examined(1.1).compared(path).status == 1
    assert not path.exists()  # a run that fails writes no baseline, so it does not pass at the next try
    assert examined(1.1).compared(path, update=True).status == 0
    stored = json.loads(path.read_text())
    assert (stored["cause"], stored["status"]) == ("wrong_adjoint", 1) or stored["cause"] == "wrong_factor"
    same = examined(1.1).compared(path)
    assert (same.status, same.changes) == (0, ["no change"])
    worse = examined(1.12).compared(path)
    assert worse.status == 1
    assert "the error was" in " ".join(worse.changes)
    better = examined(1.0).compared(path)
    assert better.status == 0
    assert "derivative was wrong, is right" in str(better)


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"status": "1"}', "\x00"])
def test_another_file_is_no_baseline(tmp_path, text):
    path = tmp_path / "baseline.json"
    path.write_text(text)
    with pytest.raises(UserError, match="baseline="):
        examined().compared(path)


def test_the_command_writes_a_baseline_of_a_wrong_gradient_only_on_request(sim, tmp_path):
    words = [f"{sim}:cost", "grad=off", "calls=300", f"baseline={tmp_path / 'baseline.json'}"]
    assert [run(*words), run(*words), run(*words, "--bench-update"), run(*words)] == [1, 1, 0, 0]


pytest_plugins = ["bench.examine.fixture"]


def test_the_fixture_fails_on_a_wrong_gradient_and_compares_with_a_baseline(examine, tmp_path):
    path = tmp_path / "baseline.json"
    with pytest.warns(match="no such file, not written"), pytest.raises(AssertionError, match="wrong_"):
        examine(cost, [1.0, 0.5], grad=lambda x: grad(x, 1.1), calls=100, baseline=path)
    with pytest.warns(match=f"baseline={path}: no such file, written"):
        examine(cost, [1.0, 0.5], grad=grad, calls=100, baseline=path)
    with pytest.raises(AssertionError, match="derivative was right, is wrong"):
        examine(cost, [1.0, 0.5], grad=lambda x: grad(x, 1.1), calls=100, baseline=path)


def test_an_option_writes_baselines_again(examine, tmp_path, pytestconfig, monkeypatch):
    path = tmp_path / "baseline.json"
    path.write_text('{"status": 0, "derivative": "right", "cause": "linear"}')
    monkeypatch.setattr(pytestconfig.option, "bench_update", True)
    examine(cost, [1.0, 0.5], grad=grad, calls=100, baseline=path)
    assert json.loads(path.read_text())["cause"] != "linear"
