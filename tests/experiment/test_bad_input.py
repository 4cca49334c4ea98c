"""Words, plugins and files that nobody should write: one line that says what is wrong, and status 2."""

import os
import subprocess
import sys

import pandas as pd
import pytest

from bench import load as load_rows
from bench.cli import main
from bench.experiment import grid
from bench.experiment.axes import table
from bench.experiment.config import load
from bench.experiment.grid import cells
from bench.model import registry
from bench.run import tasks

BASE = ["scenes=[heaviside]", "backends=[numpy]", "estimators=[fobg]", "samples=4", "repeats=3", "workers=0", "timing=false", "--quiet"]  # fmt: skip
MANY = ",".join(map(str, range(2, 220)))


@pytest.mark.parametrize(
    "words",
    [
        ["estimators=[fobg[x=!!python/object:os.system]]"], ["estimators=[fobg[a={]]"], ["scenes=[heaviside[sigma=@]]"],
        ["scenes=[heaviside[sigma=2020-13-45]]"], ["sweep={"], ["sweep={a:!x}"], ["reference=null"],
        ["seed=" + "9" * 400], ["seed=" + "9" * 5000], ["samples=" + "9" * 400], [f"sweep.seed=[{'9' * 400}]"],
        ["scene.heaviside.sigma=" + "9" * 400], [f"seed={2**53 + 1}"], ["plugins=[~nosuchuser]"],
        ["results_dir='~nosuchuser/x'"], ["--config-dir", "~nosuchuser"], ["results_dir=null"], ["results_dir=[]"],
        ["results_dir=''"], ["name=null"],
    ],
    ids=lambda words: words[-1][:30],
)  # fmt: skip
def test_odd_words_are_refused_in_one_line(tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)
    assert main(["plan", *BASE, *words]) == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith("bench: ")
    assert len(said.splitlines()) == 1
    assert len(said) < 2000
    assert not list(tmp_path.iterdir())


def test_ten_million_cells_are_refused_before_they_are_expanded(capsys, monkeypatch):
    monkeypatch.setattr(grid, "expand", lambda *_: pytest.fail("the sweep is expanded"))
    assert main(["plan", *BASE, f"sweep.seed=[{MANY}]", f"sweep.samples=[{MANY}]", f"sweep.repeats=[{MANY}]"]) == 2
    assert "the sweep has 10360232 cells" in capsys.readouterr().err


@pytest.mark.parametrize(
    "columns", [["key"], ["key", "study"], ["key", "study", "parameters"], ["bias"], ["key", "scene", "status"]]
)
def test_compare_of_files_with_missing_columns_is_one_line(tmp_path, capsys, monkeypatch, columns):
    monkeypatch.chdir(tmp_path)
    for side in ("a", "b"):
        (tmp_path / side / "x").mkdir(parents=True)
        pd.DataFrame([dict.fromkeys(columns, "bias_variance")]).to_parquet(tmp_path / side / "x" / "rows.parquet")
    assert main(["compare", "a", "b"]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert all(line.startswith("bench: ") for line in said)
    assert len(said) == 1 + ("rows are left out" in said[0])


FILES = {
    b"scenes: [heaviside\nbackends: [numpy]\n": "line 3: expected ',' or ']'",
    b"scenes: [heaviside]\n\tbackends: [numpy]\n": "line 3: found character '\\t' that cannot start any token: indent with spaces",
    b"samples: 4\nsamples: 5\n": "line 3: found duplicate key samples: give each setting once",
    b"samples: !!python/object/apply:os.system ['true']\n": "line 2: could not determine a constructor",
    b"samples: 4\nquestion: \xff\xfe\n": "line 3: not UTF-8",
    b"- a\n- b\n": "must be a table of settings",
    b"sweep: [1, 2]\n": "line 2: sweep must be a table, and is [1, 2]: write sweep: {name: value}",
    b"samples: 4\x00\n": "special characters are not allowed",
    b"samples: *b\n": "line 2: found undefined alias 'b'",
    b"samples: 4\n---\nsamples: 5\n": "line 3: but found another document: remove the line ---",
    b"1: 4\n": "line 2: 1 is not a setting",
    b"~: 4\n": "Incompatible key type",
    b"scenes: !!set {heaviside}\n": "not a supported primitive type",
    b"sweep: " + b"[" * 5000 + b"\n": "is nested too deeply",
    b"smaples: 4\n": "did you mean 'samples'?",
    b"samples: ${seed}\n": "must be a whole number",
}


@pytest.mark.parametrize("text", FILES, ids=lambda text: text[:20].decode(errors="replace").strip())
def test_an_experiment_file_that_cannot_be_read_is_named_with_its_line(tmp_path, monkeypatch, capsys, text):
    (tmp_path / "experiment").mkdir()
    path = tmp_path / "experiment" / "mine.yaml"
    path.write_bytes(b"# @package _global_\n" + text)
    assert main(["plan", "+experiment=mine", "--config-dir", str(tmp_path)]) == 2
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1
    assert FILES[text] in said
    if "did you mean" not in said and "whole number" not in said:
        assert said.startswith(f"bench: '{path}'")


def test_an_experiment_file_without_its_first_line_says_so(tmp_path, capsys):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text("samples: 4\n")
    assert main(["plan", "+experiment=mine", "--config-dir", str(tmp_path)]) == 2
    assert "must start with the line # @package _global_" in capsys.readouterr().err


@pytest.mark.parametrize("word", ["sweep={sigma:[%]}", "sweep={a:*b}", "sweep=[1,2]", "sweep={%:[1]}", "sweep.seed=range(1,2,0)", "sweep.seed=range(0.5,2)", "sweep.seed=range(0,99999999)"])  # fmt: skip
def test_an_odd_sweep_is_refused_in_one_line_with_its_cause(capsys, word):
    assert main(["plan", "+experiment=quick", word]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert said[-1].startswith("bench: ")
    assert len(said) <= 2
    assert "sweep" in said[-1] or "sigma" in said[-1]


@pytest.mark.parametrize(
    ("word", "given", "near"),
    [
        ("scene.hevaside.sigma=5", "scene 'hevaside'", "heaviside"), ("scene.pushing.mass=5", "setting of this experiment 'scene.pushing'", ""),
        ("optimizers=[adam]", "setting of this experiment 'optimizers'", ""), ("optimizer.adam.rate=-5", "setting of this experiment 'optimizer.adam'", ""),
        ("sweep.stiffness=[1,2]", "sweep axis 'stiffness'", ""), ("sweep.sigm=[1,2]", "sweep axis 'sigm'", "sigma"),
        ("marks={nosuch:{a:1}}", "mark 'nosuch'", ""),
    ],
)  # fmt: skip
def test_a_name_that_nothing_reads_is_refused_with_the_nearest_one(capsys, word, given, near):
    assert main(["plan", *BASE, word]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"bench: unknown {given}")
    assert not near or f"did you mean '{near}'?" in said
    assert "(allowed: " in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["plan", "+experiment=quick", "+experiment=twins"], "python -m bench +experiment=quick && python -m bench +experiment=twins"),
        (["plan", "+experiment=quick,twins"], "python -m bench +experiment=quick && python -m bench +experiment=twins"),
        (["stiffness_sweep", "samples=8"], "python -m bench +experiment=stiffness_sweep samples=8"),
        (["plan", "stiffness_sweep"], "write +experiment=stiffness_sweep"), (["plan", *BASE, "samples=[16,32]"], "write sweep.samples=[...]"),
        *((["plan", *BASE, f"name={name}"], f"name={name} is reserved") for name in ("claims", "references", "standard", "trace")),
        *((["plan", *BASE, f"plugins={none}"], f"plugins={none} names no folder; the current one is plugins=.") for none in ("", "''")),
        (["plan", *BASE, "scenes=[zzz]"], "python -m bench list scenes)"), (["check", "zzz"], "python -m bench list)"),
    ],
)  # fmt: skip
def test_a_message_names_the_fix(capsys, words, said):
    assert main(words) == 2
    line = capsys.readouterr().err
    assert said in line
    assert not ("zzz" in line and "did you mean" in line)
    assert len(line) < 400


ADDRESS = "is an address, and files are written on this machine"


@pytest.mark.parametrize(
    "words",
    [
        "plan results_dir={}", "plan compile_cache={}", "claims --quick results_dir={}", "compare a b out={}", "history a b out={}", "index {}",
        "engines out={}", *(f"examine a.py:cost {key}={{}}" for key in ("baseline", "save")),
    ],
)  # fmt: skip
def test_no_file_is_written_to_an_address(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*words.format("s3://rows").split(), *BASE * words.startswith("plan")]) == 2
    assert ADDRESS in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_empty_list_of_plugins_is_none():
    assert load(["plugins=[]"]).plugins == load([]).plugins == ()


def test_a_folder_with_an_accent_needs_no_quotes():
    assert load(["results_dir=résultats/é"]).results_dir.name == "é"
    assert load(["results_dir='résultats/é'"]).results_dir.name == "é"


@pytest.mark.parametrize(
    ("word", "values"),
    [
        ("sweep.seed=range(3,40)", list(range(3, 40))), ("sweep.seed=range(40,3,-2)", list(range(40, 3, -2))),
        ("sweep.seed=range(0,2)", [0, 1]), (f"sweep.seed=[{','.join(map(str, range(50)))}]", list(range(50))),
        ("sweep={seed:range(0,3)}", [0, 1, 2]), ("sweep.seed=[" + "1e2, " * 20 + "-3.5]", [100.0] * 20 + [-3.5]),
    ],
)  # fmt: skip
def test_ranges_and_long_lists_have_the_values_that_short_lists_have(word, values):
    read = load([word]).sweep["seed"]
    assert read == values
    assert [type(value) for value in read] == [type(value) for value in values]


# -------------------------------------------------------------------------------------------------------------- rows


def one():
    made = load([*BASE[:-1], "study=bias_variance"])
    return made, cells(made)[0]


def test_a_reason_is_one_line_of_a_length_that_can_be_read():
    made, cell = one()
    row = tasks.row_of(made, cell, {"status": "error", "reason": "\x1b[31m\0\n" + "x" * 3_000_000})
    assert len(row["reason"]) < 2100
    assert row["reason"].isprintable()
    assert row["reason"].endswith("characters)")


@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t=", " \r="])
def test_a_table_holds_no_formulas(start):
    made, cell = one()
    rows = made.columns.typed(pd.DataFrame([tasks.row_of(made, cell, {"status": "error"})]))
    rows = rows.assign(reason=f"{start}1+1")
    assert table(made, rows)["reason"].iloc[0] == f"'{start}1+1"


def test_windows_is_refused_in_words():
    code = "import sys; sys.platform = 'win32'; import bench.errors"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "bench runs on Linux and macOS" in done.stderr


# ------------------------------------------------------------------------------------------------------ bad plugins

HEAD = '''
"""A plugin."""
import sys
from dataclasses import dataclass
from bench.model import SampleMean, param

@dataclass(frozen=True)
class Mine(SampleMean):
    """One."""
    name = "mine"
    needs = frozenset({"grad"})
    def terms(self, problem, theta, w):
        """G."""
        return problem.grad(theta, w)
'''
BAD = {
    "exits": "import sys; sys.exit(0)",
    "exits_loudly": "import sys; sys.exit('\\x1b[31m' + 'x' * 5000000)",
    "raises": "raise BaseException('no')",
    "divides": "1/0",
    "syntax": "def (",
    "absent": "import no_such_library_anywhere",
    "recursion": "f = lambda: f()\nf()",
    "name_number": HEAD.replace('name = "mine"', "name = 7"),
    "name_brackets": HEAD.replace('name = "mine"', 'name = "a[b]"'),
    "name_escape": HEAD.replace('name = "mine"', 'name = "\\x1b[31m"'),
    "name_taken": HEAD.replace('name = "mine"', 'name = "fobg"'),
    "requires_none": HEAD.replace('name = "mine"', 'name = "r1"\n    requires = None'),
    "requires_numbers": HEAD.replace('name = "mine"', 'name = "r2"\n    requires = (1, 2)'),
    "annotation": HEAD.replace('name = "mine"', 'name = "a1"\n    x: "Nowhere" = 1'),
    "annotation_list": HEAD.replace('name = "mine"', 'name = "a2"\n    x: list = None'),
    "kind_odd": HEAD.replace('name = "mine"', 'name = "k1"\n    kind = "a b"'),
    "kind_number": HEAD.replace('name = "mine"', 'name = "k2"\n    kind = 3'),
}


@pytest.mark.parametrize("fault", BAD)
def test_a_bad_plugin_is_listed_with_its_reason_and_disables_nothing_else(tmp_path, capsys, fault):
    (tmp_path / "good.py").write_text(HEAD)
    (tmp_path / f"{fault}.py").write_text(BAD[fault])
    try:
        assert main(["list", "estimators", f"plugins={tmp_path}"]) == 0
        said = capsys.readouterr().out
        entries = [e for kind in registry.entries().values() for e in kind.values() if not e.available]
        assert len(entries) == 1
        assert "UNAVAILABLE" in said
        assert "\x1b" not in said
        assert len(said) < 50_000
        assert main(["plan", *BASE, f"plugins=[{tmp_path}]", "estimators=[fobg,mine]"]) == 0
        assert "2 cells" in capsys.readouterr().out
    finally:
        for name in [name for name in sys.modules if name.startswith("bench_folder_")]:
            del sys.modules[name]


def test_an_estimator_that_exits_ends_its_own_cell_in_this_process_too(tmp_path, capsys):
    text = HEAD.replace("return problem.grad(theta, w)", "sys.exit(0)")
    (tmp_path / "mine.py").write_text(text)
    words = [*BASE, f"plugins=[{tmp_path}]", "estimators=[fobg,mine]", f"results_dir={tmp_path / 'out'}"]
    assert main(words) == 1
    rows = pd.read_parquet(tmp_path / "out" / "custom" / "rows.parquet").set_index("estimator")
    assert rows["status"].to_dict() == {"fobg": "ok", "mine": "error"}
    assert "SystemExit" in rows["reason"]["mine"]
    assert os.getpid()


@pytest.mark.parametrize("fault", ["raise BaseException('no')", "sys.exit(0)", "raise ValueError('two\\nlines')"])
def test_a_plugin_that_cannot_be_made_is_refused_in_one_line(tmp_path, capsys, fault):
    made = HEAD.replace("    def terms", f"    def __post_init__(self):\n        {fault}\n    def terms")
    (tmp_path / "mine.py").write_text(made)
    assert main(["plan", *BASE, f"plugins=[{tmp_path}]", "estimators=[fobg,mine]"]) == 2
    said = capsys.readouterr().err.strip()
    assert "estimator 'mine' cannot be built" in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize("word", ["table.rows.sigma=[estimator]", "reference.samples.x=300"])
def test_parts_of_what_has_none_are_no_settings(word, capsys):
    assert main(["plan", "scenes=[heaviside]", "backends=[numpy]", "estimators=[fobg]", word]) == 2
    said = capsys.readouterr().err.strip()
    assert "is not a setting" in said
    assert len(said.splitlines()) == 1


def test_a_study_is_not_asked_about_cells_without_a_program(tmp_path):
    words = [
        "study=identify",
        "scenes=[hopper]",
        "contacts=[impulse]",
        "integrators=[stormer_verlet]",
        "backends=[numpy]",
    ]
    status = main([*words, "theta=[body_mass]", "optimizers=[adam]", "workers=0", "--quiet", f"results_dir={tmp_path}"])
    assert status == 0
    assert "cannot apply the impulses of contact law impulse" in load_rows(tmp_path / "custom")["reason"].iloc[0]
