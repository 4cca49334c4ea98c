"""The commands as a user types them: what runs, what is cached, and what bad input answers."""

import importlib
import json
import subprocess
import sys

import pandas as pd
import pytest
from bench.plugins.studies.bias_variance.columns import COLUMNS
from helpers import TINY
from trees import INHERITED

from bench.cli import VERBS, main
from bench.experiment import config, grid
from bench.experiment.columns import IDENTITY


def test_run_then_report_then_plan(tmp_path, capsys):
    where = f"results_dir={tmp_path}"
    assert main([*TINY, where, "sweep.sigma=[0.1,0.2]"]) == 0
    directory = tmp_path / "tiny"
    for name in ("rows.parquet", "bias_variance.csv", "bias_variance.md", "bias_variance.tex", "run.json"):
        assert (directory / name).stat().st_size > 0
    table = pd.read_csv(directory / "bias_variance.csv")
    assert list(table.columns) == [*COLUMNS.table, "study", "parameters"]
    assert len(table) == 4
    assert (table["status"] == "ok").all()
    assert json.loads((directory / "run.json").read_text())["counts"] == {"ok": 4}
    printed = capsys.readouterr().out
    assert f"Page: {directory / 'report.html'}" in printed

    for path in directory.iterdir():
        if path.is_file() and path.name != "rows.parquet":
            path.unlink()
    assert main(["report", *TINY, where, "sweep.sigma=[0.1,0.2]"]) == 0
    again = pd.read_csv(directory / "bias_variance.csv")
    pd.testing.assert_frame_equal(again, table)
    capsys.readouterr()
    assert main(["plan", *TINY, where, "sweep.sigma=[0.1,0.2,0.3]"]) == 0
    assert "6 cells, 4 stored, 2 to run" in capsys.readouterr().out


def test_only_missing_cells_run_and_rows_are_kept(tmp_path, monkeypatch):
    module = importlib.import_module("bench.plugins.studies.bias_variance.measure")

    measured = []
    real = module.measure
    monkeypatch.setattr(module, "measure", lambda cell, *rest: (measured.append(cell.key), real(cell, *rest))[1])
    where = f"results_dir={tmp_path}"
    here = [*TINY, where]
    assert main([*here, "sweep.sigma=[0.1]"]) == 0
    assert main([*here, "sweep.sigma=[0.1,0.2]"]) == 0
    assert len(measured) == len(set(measured)) == 4
    assert main([*here, "sweep.sigma=[0.2]"]) == 0
    assert len(pd.read_parquet(tmp_path / "tiny" / "rows.parquet")) == 4
    assert len(pd.read_csv(tmp_path / "tiny" / "bias_variance.csv")) == 2


@pytest.mark.slow
def test_record_of_a_run_outlasts_one_that_finds_all_rows_stored(tmp_path):
    here = [*TINY, f"results_dir={tmp_path}", "formats=[]"]
    path = tmp_path / "tiny" / "run.json"
    assert main([*here, "sweep.sigma=[0.1,0.2]"]) == 0
    first = path.read_text()
    assert main([*here, "sweep.sigma=[0.1,0.2]"]) == 0
    assert path.read_text() == first
    assert main([*here, "sweep.sigma=[0.1]"]) == 0
    assert json.loads(path.read_text())["counts"] == {"ok": 2}


def test_identity_columns_tell_cells_apart():
    words = [
        "scenes=[pushing]",
        "contacts=[impulse,'impulse[time_of_impact=false]','softplus[beta=10,smooths=clip]',softplus]",
        "backends=[numpy]",
        "estimators=[reinforce,'reinforce[baseline=none]']",
    ]
    table = pd.DataFrame([cell.columns() for cell in grid.cells(config.load(words))])
    assert len(table) == 8
    assert not table.duplicated(list(set(IDENTITY) & set(table))).any()
    assert set(table["contact"]) == {"impulse", "impulse[time_of_impact=false]", "softplus[smooths=clip]", "softplus"}
    assert set(table["estimator_params"]) == {"", "baseline=none"}


def test_results_directory_that_cannot_be_made(tmp_path, capsys):
    blocker = tmp_path / "file"
    blocker.write_text("mine")
    assert main([*TINY, f"results_dir={blocker}"]) == 2
    assert "cannot be written" in capsys.readouterr().err
    assert blocker.read_text() == "mine"


def test_help_names_the_experiments_and_fits_80_columns(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert "stiffness_sweep" in text
    assert "optimise/small" in text
    assert max(map(len, text.splitlines())) <= 80
    family = text.partition("Is it right?")[2].partition("\n\n")[0]
    assert [name for name in ("check ", "gradcheck ", "examine ", "trace ", "compare ") if f"\n  {name}" in family] == [
        "check ",
        "gradcheck ",
        "examine ",
        "trace ",
    ]


def test_a_swept_axis_of_the_command_line_replaces_that_of_the_file(capsys):
    assert main(["plan", "+experiment=optimise/small", "sweep.seed=[0]"]) == 0
    assert capsys.readouterr().out.startswith("quick_optimise: "), "the folder of its results"


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help(verb, capsys):
    assert main([verb, "--help"]) == 0
    answer = capsys.readouterr()
    assert VERBS[verb].does in answer.out
    assert "python -m bench" in answer.out
    assert answer.err == ""


@pytest.mark.parametrize("words", [["--version"], ["plan", "--version"]])
def test_version(words, capsys):
    """After a verb it was an unknown option."""
    assert main(words) == 0
    assert capsys.readouterr().out.startswith("bench 0.")


def test_list_without_a_kind_prints_kinds_and_names(capsys):
    """It printed 733 lines."""
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 40
    assert {line.partition(":")[0] for line in lines if not line.startswith(" ")} >= {"scenes", "estimators", "studies"}
    assert main(["list", "scenes"]) == 0
    assert [line for line in capsys.readouterr().out.split("\n") if line and line[0] != " "] == ["scenes"]


def test_a_plan_without_rows_of_its_own_takes_the_times_of_the_standard_results(capsys, tmp_path):
    assert main(["plan", "+experiment=quick", f"results_dir={tmp_path}"]) == 0
    assert "expected time: about" in capsys.readouterr().out


@pytest.mark.slow
def test_files_are_written_before_anything_is_printed(tmp_path):
    """A reader that goes away at once, as ``head`` does, costs no file."""
    words = [sys.executable, "-m", "bench", *TINY, f"results_dir={tmp_path}", "--quiet"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        run.stdout.close()
        run.wait(timeout=120)
    names = {path.name for path in (tmp_path / "tiny").iterdir()}
    assert {"rows.parquet", "run.json", "bias_variance.csv", "report.html"} <= names


ESCAPING = '''
from dataclasses import dataclass
from bench.plugin import SampleMean

@dataclass(frozen=True)
class Escaping(SampleMean):
    """Colours \\x1b[31m and \\x07 bells in its docstring."""
    name = "escaping"
    needs = frozenset({"grad"})
    def terms(self, problem, theta, w):
        raise ValueError("red \\x1b[31m alert")
'''


NAMED = """
theta = {"\\x1b[31mred": 0.3}
cost = lambda x: x["\\x1b[31mred"] ** 2
grad = lambda x: {"\\x1b[31mred": 5.0}
"""


def test_nothing_raw_reaches_the_terminal(tmp_path, capsys):
    folder = tmp_path / "own"
    folder.mkdir()
    (folder / "escaping.py").write_text(ESCAPING)
    assert main(["list", "escaping", f"plugins={folder}"]) == 0
    words = ["scenes=[heaviside]", "backends=[numpy]", "estimators=[escaping]", "samples=8", "repeats=4", "name=raw"]
    assert main([*words, "workers=0", f"plugins={folder}", f"results_dir={tmp_path}"]) == 1
    (folder / "cost.py").write_text(NAMED)
    assert main(["examine", f"{folder}/cost.py:cost", "theta=theta", "grad=grad", "calls=300"]) == 1
    answer = capsys.readouterr()
    assert "alert" in answer.out
    for letter in ("\x1b", "\x07"):
        assert letter not in answer.out
        assert letter not in answer.err


def test_a_thread_of_a_plugin_and_a_closed_stream_do_not_keep_a_command_waiting(tmp_path):
    """Without a shutdown by Python, what was printed arrives all the same, and the status is that of the command."""
    code = """if True:
        import sys, threading, time
        import bench.__main__ as command
        from bench import cli
        threading.Thread(target=time.sleep, args=(600,)).start()
        def main():
            print("all of it")
            sys.stderr.close()
            return 3
        cli.main = main
        command.command()
    """
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=INHERITED, capture_output=True, timeout=500)
    assert done.returncode == 3
    assert done.stdout == b"all of it\n"
