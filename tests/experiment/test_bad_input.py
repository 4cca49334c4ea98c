"""Words, plugins and files that nobody should write: one line that says what is wrong, and status 2."""

import subprocess
import sys

import pandas as pd
import pytest

from bench import load as load_rows
from bench.cli import VERBS, main
from bench.experiment import grid
from bench.experiment.axes import table
from bench.experiment.config import load
from bench.experiment.grid import cells
from bench.model import registry
from bench.run import tasks

BASE = [
    "scenes=[heaviside]",
    "backends=[numpy]",
    "estimators=[fobg]",
    "samples=4",
    "repeats=3",
    "workers=0",
    "timing=false",
    "--quiet",
]
MANY = ",".join(map(str, range(2, 220)))


ADDRESS = "is an address, and files are written on this machine"
REFUSED = {
    # names
    "+experiment=stifness_sweep": "did you mean 'stiffness_sweep'",
    "+experiment=": "names no experiment",
    "scenes=[pushng]": "did you mean 'pushing'",
    "scenes=[pushing] sweep.stifness=[1e3]": "did you mean 'stiffness'",
    "nonsense=1": "(allowed: ",
    "rum": "did you mean 'run'",
    "scenes=[pushing] scene.pushing.mas=0.2": "did you mean 'mass'",
    "--verison": "unknown option '--verison'; did you mean '--version'?",
    "report quik": "unknown experiment 'quik'; did you mean 'quick'?",
    "scenes=[pushing] scene.pushing.mass=nan": "pushing.mass=nan must be a number",
    "list fbog": "did you mean 'fobg'",
    "study='stability[diverge=3]'": "did you mean 'diverged'",
    "scene.hevaside.sigma=5": "scene 'hevaside'; did you mean 'heaviside'?",
    "scene.pushing.mass=5": "unknown setting of this experiment 'scene.pushing'",
    "optimizers=[adam]": "unknown setting of this experiment 'optimizers' (allowed: ",
    "sweep.stiffness=[1,2]": "unknown sweep axis 'stiffness' (allowed: ",
    "marks={nosuch:{a:1}}": "unknown mark 'nosuch' (allowed: ",
    "compare . . agian=a": "did you mean 'again'",
    "compare --output=/tmp/x .": "unknown option of compare '--output=/tmp/x'",
    "history . . output=x": "did you mean 'out'",
    "compares={nosuch:[1]}": "unknown part of compares 'nosuch' (allowed: ",
    "study=[bias_variance]": "study=[bias_variance] must be one name",
    "x" * 5000: "unknown command",
    "also=3": "also=3 must be a string",
    "scenes=[heaviside[sigma=1,sigma=2]]": "'sigma' has two values",
    "name=" + "x" * 300: "must be at most 100 letters",
    "compile_cache=/dev/null": "is not a folder",
    # values
    "scenes=[]": "scenes is empty",
    "scenes=[pushing] sweep.stiffness=[abc]": "must be a number",
    "scenes=[pushing] sweep.stiffness=[-1]": "penalty.stiffness=-1 must be greater than 0",
    "samples=0": "samples=0 must be at least 1",
    "scenes=[pushing] scene.pushing.mass=heavy": "pushing.mass='heavy' must be a number",
    "scene.heaviside=3": "scene.heaviside=3",
    "sweep={zip:{sigma:[0.1],samples:[3,4]}}": "equally long",
    "reference.samples=1": "reference.samples",
    "hydra.run.dir=/tmp": "Hydra",
    "scenes=[pushing] theta=[mass] theta0=[1,2]": "theta0 has 2 values, theta of scene pushing has 1",
    "plugins=nowhere_at_all": "is not a folder",
    "plugins=[~nosuchuser]": "unknown user name",
    "reference=null": "reference.samples=...",
    "--config-dir nowhere_at_all +experiment=quick": "experiment/NAME.yaml",
    "plan --config-dir ~nosuchuser": "~",
    "seed=" + "9" * 400: "at most",
    f"sweep.seed=[{'9' * 400}]": "at most",
    "scene.heaviside.sigma=" + "9" * 400: "largest float",
    f"seed={2**53 + 1}": "at most",
    "results_dir='~nosuchuser/x'": "~",
    "results_dir=null": "must be a folder",
    "estimators=[reinforce[baseline=center]": "cannot be read",
    "name=../up": "name='../up'",
    "estimators=[fobg[x=!!python/object:os.system]]": "fobg",
    "scenes=[heaviside[sigma=2020-13-45]]": "sigma",
    "sweep={": "sweep",
    "sweep={a:!x}": "sweep",
    "sweep=[1,2]": "sweep",
    "sweep.sigma=[[1]]": "sigma",
    "sweep.seed=range(1,2,0)": "is not a range",
    "descent=1": "below 1",
    "sweep.descent=[0,-0.1]": "at least 0",
    "path=[penalty]": "a contact law, an integrator",
    "sweep.seed=range(0,99999999)": "values, and more than",
    f"sweep.seed=[{MANY}] sweep.samples=[{MANY}] sweep.repeats=[{MANY}]": "the sweep has 10360232 cells",
    **{
        f"shard='{shard}'": "must be NUMBER/COUNT, such as 3/64, with NUMBER from 1 to COUNT"
        for shard in ("65/64", "a/b")
    },
    "estimators=[fobg[draws=sobol]] draws=iid": "fobg[draws=sobol] gives draws, which the sweep varies: leave one",
    "name=claims": "name=claims is reserved",
    "scenes=[quadratic] sweep.theta0.9=[1]": "theta has 5 coordinates",
    "scenes=[quadratic] sweep.theta0.0=[inf]": "must be finite",
    "scenes=[quadratic] sweep.theta0.0=[[1,2]]": "one number at a time",
    "sweep.theta0=[one]": "theta0",
    "scenes=[quadratic] sweep.theta1=[1]": "did you mean 'theta0'",
    "scenes=[quadratic] sweep.theta0=[[1,2]]": "theta0 has 2 values, theta of scene quadratic has 5",
    # the message names the fix
    "-m +experiment=quick,stiffness_sweep": "leave out --multirun",
    "plan +experiment=quick +experiment=twins": "python -m bench +experiment=quick && python -m bench +experiment=twins",
    "stiffness_sweep samples=8": "python -m bench +experiment=stiffness_sweep samples=8",
    "plan stiffness_sweep": "write +experiment=stiffness_sweep",
    "samples=[16,32]": "write sweep.samples=[...]",
    "plugins=": "plugins= names no folder; the current one is plugins=.",
    "plugins=''": "plugins='' names no folder; the current one is plugins=.",
    "scenes=[zzz]": "'zzz' (allowed: ",
    "check zzz": "python -m bench list)",
    "gradcheck": "name a scene: python -m bench gradcheck",
    "trace": "name a scene: python -m bench trace",
    "report": "no rows are stored",
    "check mysim.py:cost": "python -m bench examine mysim.py:cost",
    "gradcheck mysim.py:cost backends=[jax]": "python -m bench examine mysim.py:cost",
    "gradcheck fobg": "python -m bench check fobg",
    "examine fobg": "python -m bench check fobg",
    "examine pushing[horizon=3] theta=1": "python -m bench gradcheck pushing[horizon=3]",
    "compare here": "name two results",
    "compare no-such-thing .": "neither a directory nor a git revision",
    "compare . .": "no results",
    "compare . . again=a": "needs 3 or more runs of before",
    "history .": "name two results or more",
    "index nowhere": "is not a folder",
    "index .": "no experiments",
    "index a b": "name one folder",
    # no file is written to an address
    "results_dir=s3://rows": ADDRESS,
    "compile_cache=s3://rows": ADDRESS,
    "claims --quick results_dir=s3://rows": ADDRESS,
    "compare a b out=s3://rows": ADDRESS,
    "index s3://rows": ADDRESS,
    "engines table out=s3://rows": ADDRESS,
    "examine a.py:cost save=s3://rows": ADDRESS,
}
"""Words of a command, and what its message has. Words of a run, plan or report follow those of BASE."""


@pytest.mark.parametrize("words", REFUSED, ids=lambda words: words[:60])
def test_refused_in_one_line_that_names_the_fault_before_anything_is_written(tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)
    first, *rest = words.split()
    given = [first, *rest] if first in VERBS or "=" not in first else [*BASE, first, *rest]
    assert main([first, *BASE, *rest] if first in ("plan", "report") else given) == 2
    answer = capsys.readouterr()
    assert answer.out == ""
    assert answer.err.startswith("bench: ")
    assert len(answer.err.strip().splitlines()) == 1
    assert len(answer.err) < 600
    assert REFUSED[words] in answer.err
    assert not ("zzz" in words and "did you mean" in answer.err)
    assert not list(tmp_path.iterdir())


def test_a_sweep_that_is_too_large_is_not_expanded(monkeypatch):
    monkeypatch.setattr(grid, "expand", lambda *_: pytest.fail("the sweep is expanded"))
    assert main(["plan", *BASE, f"sweep.seed=[{MANY}]", f"sweep.samples=[{MANY}]", f"sweep.repeats=[{MANY}]"]) == 2


@pytest.mark.parametrize("columns", [["key"], ["bias"], ["key", "scene", "status"]])
def test_compare_of_files_with_missing_columns_is_one_line(tmp_path, capsys, monkeypatch, columns):
    monkeypatch.chdir(tmp_path)
    for side in ("a", "b"):
        (tmp_path / side / "x").mkdir(parents=True)
        pd.DataFrame([dict.fromkeys(columns, "bias_variance")]).to_parquet(tmp_path / side / "x" / "rows.parquet")
    assert main(["compare", "a", "b"]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert all(line.startswith("bench: ") for line in said)
    assert len(said) == 1


FILES = {
    b"scenes: [heaviside\nbackends: [numpy]\n": "line 3, column 9",
    b"samples: 4\nsamples: 5\n": "found duplicate key samples in",
    b"samples: !!python/object/apply:os.system ['true']\n": "could not determine a constructor",
    b"samples: 4\nquestion: \xff\xfe\n": "'utf-8' codec can't decode",
    b"- a\n- b\n": "must be a table of settings",
    b"sweep: [1, 2]\n": "line 2: sweep must be a table, and is [1, 2]: write sweep: {name: value}",
    b"samples: 4\x00\n": "special characters are not allowed",
    b"samples: 4\n---\nsamples: 5\n": "but found another document",
    b"1: 4\n": "line 2: 1 is not a setting",
    b"~: 4\n": "Incompatible key type",
    b"smaples: 4\n": "did you mean 'samples'?",
    b"samples: ${seed}\n": "must be a whole number",
    b"sweep: &a {b: *a}\n": "line 2: *a is an alias",
    b"samples: 4\n": "must start with the line # @package _global_",
}


@pytest.mark.parametrize("text", FILES, ids=lambda text: text[:20].decode(errors="replace").strip())
def test_an_experiment_file_that_cannot_be_read_is_named_with_its_line(tmp_path, monkeypatch, capsys, text):
    (tmp_path / "experiment").mkdir()
    path = tmp_path / "experiment" / "mine.yaml"
    path.write_bytes(b"# @package _global_\n" * (text != b"samples: 4\n") + text)
    assert main(["plan", "+experiment=mine", "--config-dir", str(tmp_path)]) == 2
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1
    assert FILES[text] in said
    if "did you mean" not in said and "whole number" not in said:
        assert said.startswith(f"bench: '{path}'")


def test_a_folder_with_an_accent_needs_no_quotes():
    assert load(["results_dir=résultats/é"]).results_dir.name == "é"


@pytest.mark.parametrize(
    ("word", "values"),
    [
        ("sweep.seed=range(40,3,-2)", list(range(40, 3, -2))),
        ("sweep={seed:range(0,3)}", [0, 1, 2]),
        ("sweep.seed=[" + "1e2, " * 20 + "-3.5]", [100.0] * 20 + [-3.5]),
    ],
)
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


@pytest.mark.parametrize("start", ["=", "@", " \r="])
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
    "raises": "raise BaseException('no')",
    "syntax": "def (",
    "absent": "import no_such_library_anywhere",
    "recursion": "f = lambda: f()\nf()",
    "name_number": HEAD.replace('name = "mine"', "name = 7"),
    "name_brackets": HEAD.replace('name = "mine"', 'name = "a[b]"'),
    "name_taken": HEAD.replace('name = "mine"', 'name = "fobg"'),
    "requires_none": HEAD.replace('name = "mine"', 'name = "r1"\n    requires = None'),
    "annotation": HEAD.replace('name = "mine"', 'name = "a1"\n    x: "Nowhere" = 1'),
    "abstract": HEAD.replace('name = "mine"', 'name = "a2"').replace("def terms", "def others"),
    "kind_odd": HEAD.replace('name = "mine"', 'name = "k1"\n    kind = "a b"'),
}


def test_bad_plugins_are_listed_with_their_reasons_and_disable_nothing_else(tmp_path, capsys):
    (tmp_path / "good.py").write_text(HEAD)
    for fault, source in BAD.items():
        (tmp_path / f"{fault}.py").write_text(source)
    try:
        assert main(["list", "estimators", f"plugins={tmp_path}"]) == 0
        said = capsys.readouterr().out
        entries = [e for kind in registry.entries().values() for e in kind.values() if not e.available]
        assert len(entries) == len(BAD)
        assert all(entry.reason for entry in entries)
        assert said.count("UNAVAILABLE") >= len(BAD)
        assert "\x1b" not in said
        assert len(said) < 50_000
        assert main(["plan", *BASE, f"plugins=[{tmp_path}]", "estimators=[fobg,mine]"]) == 0
        assert "2 cells" in capsys.readouterr().out
    finally:
        for name in [name for name in sys.modules if name.startswith("bench_folder_")]:
            del sys.modules[name]


def test_an_unknown_plugin_is_answered_with_the_files_that_failed(tmp_path, capsys):
    (tmp_path / "raises.py").write_text("import os\n\nraise RuntimeError('boom')\n")
    (tmp_path / "wrong.py").write_text("x = = 2\n")
    (tmp_path / "bare.py").write_text(
        HEAD.replace("@dataclass(frozen=True)\n", "").replace('"mine"', '"bare"\n    gain: float = 1.0')
    )
    for words in (["plan", *BASE, "estimators=[mine]"], ["check", "mine"], ["list", "mine"]):
        assert main([*words, f"plugins={tmp_path}"]) == 2
        said = capsys.readouterr().err
        assert "unknown" in said
        assert "raises: import failed: RuntimeError: boom (raises.py:3)" in said
        assert "SyntaxError: invalid syntax (wrong.py, line 1)" in said
        assert "is not a dataclass" in said
        assert "(bare.py)" in said
        assert "bench_folder_" not in said
    assert main(["list", "estimators", f"plugins={tmp_path}"]) == 0
    assert "bench_folder_" not in "".join(capsys.readouterr())


def test_an_estimator_that_exits_ends_its_own_cell_in_this_process_too(tmp_path, capsys):
    text = HEAD.replace("return problem.grad(theta, w)", "sys.exit(0)")
    (tmp_path / "mine.py").write_text(text)
    words = [*BASE, f"plugins=[{tmp_path}]", "estimators=[fobg,mine]", f"results_dir={tmp_path / 'out'}"]
    assert main(words) == 1
    rows = pd.read_parquet(tmp_path / "out" / "custom" / "rows.parquet").set_index("estimator")
    assert rows["status"].to_dict() == {"fobg": "ok", "mine": "error"}
    assert "SystemExit" in rows["reason"]["mine"]


@pytest.mark.parametrize("fault", ["sys.exit(0)", "raise ValueError('two\\nlines')"])
def test_a_plugin_that_cannot_be_made_is_refused_in_one_line(tmp_path, capsys, fault):
    made = HEAD.replace("    def terms", f"    def __post_init__(self):\n        {fault}\n    def terms")
    (tmp_path / "mine.py").write_text(made)
    assert main(["plan", *BASE, f"plugins=[{tmp_path}]", "estimators=[fobg,mine]"]) == 2
    said = capsys.readouterr().err.strip()
    assert "estimator 'mine' cannot be built" in said
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
