"""For CI: exit statuses, baselines, summaries, and many costs in one command."""

import json
from xml.etree import ElementTree

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
    assert run(f"{sim}:nothing", "grad=zero", "calls=300") == 3
    assert run(f"{sim}:nothing", "grad=zero", "calls=300", "allow_zero=true") == 0
    assert run(f"{sim}:cost", "grad=wrong") == 2
    assert run(f"{sim}:kinked", "grad=side", "calls=1000") == 1
    assert run(f"{sim}:kinked", "grad=side", "calls=1000", "expect=kink") == 0
    out = capsys.readouterr()
    assert "the cause is kink, as expected" in out.out
    assert f"next: choose a theta beside it, or python -m bench examine {sim}:kinked grad=side" in out.out


def test_settings_of_the_command_line(sim, capsys):
    settings = [
        "tolerance=theta[0]:0.3",
        "atol=1e-9",
        "compile_budget=5s",
        "twin=cost",
        "refined=cost",
        "twin_grad=right",
    ]
    assert run(f"{sim}:cost", "grad=off", "calls=400", *settings) == 0
    assert "small error, within the tolerance" in capsys.readouterr().out
    assert run(f"{sim}:cost", "expect=nonsense") == 2
    assert run(f"{sim}:cost", "tolerance=1,2") == 2


# -------------------------------------------------------------------------------------------- baseline


def test_a_baseline_accepts_what_was_there_and_refuses_what_is_worse(tmp_path):
    path = tmp_path / "baseline.json"
    assert examined(1.1).compared(path).status == 1  # written: the first run still fails
    stored = json.loads(path.read_text())
    assert (stored["cause"], stored["status"]) == ("wrong_adjoint", 1) or stored["cause"] == "wrong_factor"
    same = examined(1.1).compared(path)
    assert (same.status, same.changes) == (0, ["no change"])
    worse = examined(1.5).compared(path)
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


# -------------------------------------------------------------------------------------------- summaries


def test_summaries_in_markdown_and_junit():
    for report, kind in ((examined(), None), (examined(1.1), "failure"), (examined(calls=3), "error")):
        case = ElementTree.fromstring(report.junit()).find("testsuite/testcase")
        assert [child.tag for child in case if child.tag != "system-out"] == ([kind] if kind else [])
        assert "| cost | result | cause |" in report.markdown()
    assert "| wrong |" in examined(1.1).markdown()
    assert "- next: follow theta[0]" in examined(1.1).markdown()
    assert "| not decided | undecided |" in examined(calls=3).markdown()


def test_names_cannot_break_the_summaries():
    report = examined(1.1, name="a|b <script>\x01")
    assert "a\\|b &lt;script>" in report.markdown()
    assert ElementTree.fromstring(report.junit()).find("testsuite/testcase").get("name") == "a|b <script>?"


def test_matrix_runs_many_costs_into_one_table(sim, tmp_path, capsys):
    matrix = tmp_path / "matrix.toml"
    matrix.write_text(
        '[defaults]\ncalls = 400\n'
        '[[cost]]\ncost = "sim.py:cost"\ngrad = "right"\n'
        '[[cost]]\nname = "off"\ncost = "sim.py:cost"\ngrad = "off"\ntheta = [1.0, 2.0]\n'
        '[[cost]]\nname = "tolerated"\ncost = "sim.py:cost"\ngrad = "off"\ntolerance = {"theta[0]" = 0.2}\n'
        '[[cost]]\nname = "known"\ncost = "sim.py:kinked"\ngrad = "side"\nexpect = "kink"\ncalls = 1000\n'
        '[[cost]]\nname = "short"\ncost = "sim.py:cost"\ngrad = "right"\ncalls = 3\n'
    )  # fmt: skip
    outputs = [f"markdown={tmp_path / 'summary.md'}", f"junit={tmp_path / 'examine.xml'}"]
    assert run("--matrix", matrix, *outputs) == 1
    out = capsys.readouterr().out
    assert "5 costs: 3 right, 1 wrong, 1 not decided" in out
    assert ElementTree.parse(tmp_path / "examine.xml").getroot().attrib == {
        "name": "examine", "tests": "5", "failures": "1", "errors": "1",
    }  # fmt: skip
    assert "| known | as expected | kink |" in (tmp_path / "summary.md").read_text()


def test_matrix_goes_on_after_bad_input(sim, tmp_path, capsys):
    matrix = tmp_path / "matrix.toml"
    matrix.write_text('[[cost]]\ncost = "sim.py:cots"\n[[cost]]\ncost = "sim.py:cost"\ngrad = "right"\ncalls = 300\n')
    assert run("--matrix", matrix) == 2
    assert "2 costs: 1 right, 1 bad input" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "needs one"),
        ("[[cost]]\n", "has no cost"),
        ("x = 1\n[[cost]]\ncost = 'sim.py:cost'\n", "unknown: x"),
        ("[[cost]]\ncost = 'sim.py:cost'\ncall = 1\n", "did you mean 'calls'"),
        ("[[cost\n", "is not TOML"),
    ],
)
def test_matrix_files_that_are_wrong_say_why(sim, tmp_path, capsys, text, said):
    matrix = tmp_path / "matrix.toml"
    matrix.write_text(text)
    assert run("--matrix", matrix) == 2
    assert said in capsys.readouterr().err


pytest_plugins = ["bench.examine.fixture"]


def test_the_fixture_fails_on_a_wrong_gradient_and_compares_with_a_baseline(examine, tmp_path):
    path = tmp_path / "baseline.json"
    examine(cost, [1.0, 0.5], grad=grad, calls=100, baseline=path)
    with pytest.raises(AssertionError, match=r"wrong_(factor|adjoint)"):
        examine(cost, [1.0, 0.5], grad=lambda x: grad(x, 1.1), calls=100)
    with pytest.raises(AssertionError, match="derivative was right, is wrong"):
        examine(cost, [1.0, 0.5], grad=lambda x: grad(x, 1.1), calls=100, baseline=path)
