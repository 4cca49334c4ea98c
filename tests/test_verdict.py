"""A command that judges says its verdict, or its status is 3: code that ends the process does not answer for it."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys

import pytest
from trees import INHERITED, ROOT, bench, hearing_signals, processes_in, wait_for

from bench.cli import main
from bench.simulator.imports import load_module

COST = """
import ctypes, os, signal, sys, time
theta, calls = [0.4, 0.3], []
def cost(x):
    calls.append(1)
    if len(calls) == 11: {end}
    return x[0] ** 2 * x[1]
def grad(x): return [-2 * x[0] * x[1], x[0] ** 2]
"""
POOL = """
import multiprocessing
theta, loop = [0.4, 0.3], []
loop.append(loop)
def square(v): return v**2
def cost(x):
    with multiprocessing.get_context("spawn").Pool(1) as pool: return sum(pool.map(square, [float(v) for v in x]))
def grad(x): return [2 * v for v in x]
"""
PLUGINS = '''
"""A scene and an estimator that end the process."""

import os
import sys
from dataclasses import dataclass

from bench.plugin import FunctionScene, SampleMean, param


@dataclass(frozen=True)
class Ends(FunctionScene):
    """Ends the process when it is asked for theta."""

    name = "ends"
    sigma: float = param(0.1, "noise")

    def theta0(self):
        {end}

    def cost(self, xp, theta):
        return (theta**2).sum(0)


@dataclass(frozen=True)
class Leaves(SampleMean):
    """Ends the process when it is asked what it needs."""

    name = "leaves"

    @property
    def needs(self):
        {end}

    def terms(self, problem, theta, w):
        return problem.grad(theta, w)
'''
ENDS = {
    "exit": "os._exit(0)",
    "c_exit": "ctypes.CDLL(None).exit(0)",
    "crash": "ctypes.string_at(0)",
    "killed": "os.kill(os.getpid(), signal.SIGKILL)",
}
RUN = ["scenes=[ends]", "backends=[numpy]", "estimators=[fobg]", "timing=false"]
VERBS = {
    "run": [*RUN, "workers=0"],
    "plan": RUN,
    "list": ["leaves"],
    "gradcheck": ["ends", "workers=0"],
    "trace": ["ends", "backends=[numpy]"],
}
"""Commands that run the plugins in a process of their own."""
LISTED = {"list": 0, "gradcheck": 1}
"""The status of a verdict on a plugin that calls sys.exit."""


def status_of(folder, *words):
    """Return the exit status and the printed errors of a command."""
    done = bench(*words, folder=folder)
    return done.returncode, done.stderr


@pytest.mark.parametrize("end", ENDS)
def test_a_cost_that_ends_the_process_is_not_right(end, tmp_path):
    (tmp_path / "mine.py").write_text(COST.format(end=ENDS[end]))
    status, said = status_of(tmp_path, "examine", "mine.py:cost", "grad=grad", "--quiet")
    assert status == 3
    assert "before a verdict" in said


@pytest.mark.slow
def test_the_status_of_a_verdict_and_of_bad_input_arrives(tmp_path):
    (tmp_path / "mine.py").write_text(COST.format(end="pass"))
    assert status_of(tmp_path, "examine", "mine.py:cost", "grad=grad", "--quiet")[0] == 1
    assert status_of(tmp_path, "examine", "mine.py:nothing")[0] == 2


@pytest.mark.slow
@pytest.mark.parametrize("verb", VERBS)
def test_a_plugin_that_ends_the_process_gives_no_status(verb, tmp_path):
    """The status is 0 only after a verdict, wherever the process ends."""
    (tmp_path / "mine").mkdir()
    for end, expected in (("os._exit(0)", 3), ("sys.exit(0)", LISTED.get(verb, 3))):
        (tmp_path / "mine" / "ends.py").write_text(PLUGINS.format(end=end))
        status, said = status_of(tmp_path, verb, *VERBS[verb], f"plugins={tmp_path / 'mine'}")
        assert status == expected, said
        assert ("before a verdict" in said) == (expected == 3)


ENDS_IMPORT = 'import os\nif "BENCH_TRIAL" not in os.environ: os._exit(0)\n'
"""A plugin file that ends the process of a command that imports it."""


@pytest.fixture(scope="module")
def ending(tmp_path_factory):
    """A folder with rows of a run, and a folder of plugins beside it that ends commands."""
    folder = tmp_path_factory.mktemp("ending")
    words = ["scenes=[quadratic]", "backends=[numpy]", "estimators=[fobg]", "samples=8", "repeats=4", "timing=false"]
    assert main([*words, "workers=0", "--quiet", f"results_dir={folder / 'rows'}"]) == 0
    (folder / "mine").mkdir()
    (folder / "mine" / "ends.py").write_text(ENDS_IMPORT)
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ["engines"],
        *(
            pytest.param(words.split(), marks=pytest.mark.slow)
            for words in ("compare rows rows", "history rows rows", "claims --list")
        ),
    ],
)
def test_no_verb_answers_for_a_file_that_ends_its_process(words, ending):
    status, said = status_of(ending, *words, f"plugins={ending / 'mine'}")
    assert status == 3
    assert "before a verdict" in said


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (0, "compare rows rows"),
        (2, "compare rows nothing"),
        (2, "compare rows"),
        (0, "history rows rows"),
        (2, "history rows"),
        (0, "index rows"),
        (2, "index nothing"),
        (2, "index --all"),
        (0, "claims --list"),
        (2, "claims nothing"),
        (0, "engines"),
        (2, "engines install nothing"),
        (2, "engines --all"),
    ],
)
def test_statuses_of_the_other_verbs(status, words, ending, monkeypatch):
    monkeypatch.chdir(ending)
    assert main(words.split()) == status


RAISES = """
import sys
import bench.__main__ as command
from bench import cli
from bench.model import registry

def main():
    if sys.argv[2:]:
        registry.add_folder(registry.Path(sys.argv[2]))
        registry.entries()
    {raises}

cli.main = main
command.command()
"""


@pytest.mark.parametrize(
    ("raises", "status", "said"),
    [
        ("raise MemoryError", 1, "bench: not enough memory: "),
        pytest.param(
            "1 / 0", 70, "bench: internal error: ZeroDivisionError: division by zero (", marks=pytest.mark.slow
        ),
    ],
)
def test_a_command_without_memory_and_one_with_a_bug_say_so_in_a_line(raises, status, said):
    """An internal error has a status of its own, since 1 is the verdict that something is wrong."""
    done = subprocess.run([sys.executable, "-c", RAISES.format(raises=raises)], capture_output=True, text=True)
    assert done.returncode == status
    assert done.stderr.startswith(said)
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_an_error_beside_code_from_outside_names_it_in_a_line(tmp_path):
    (tmp_path / "outside.py").write_text("")
    code = RAISES.format(raises="1 / 0")
    done = subprocess.run([sys.executable, "-c", code, "", str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 70
    assert re.search(r"ZeroDivisionError: division by zero \(.*\); imported from outside: \w+\.outside", done.stderr)


FORKS = """if os.fork():
        os.wait()
    else:
        os.setsid()
        if os.fork() == 0: time.sleep(600)
        os._exit(0)
    if len(calls) == 11: open("begun", "w").close(); time.sleep(float(os.environ["HANGS"]))"""


ORPHAN = """if len(calls) == 11:
        import subprocess
        code = "import subprocess; subprocess.Popen(['sleep', '600'], env={}, start_new_session=True)"
        subprocess.run([sys.executable, "-c", code], env={}, start_new_session=True)
        time.sleep(2.5)
        open("begun", "w").close(); time.sleep(float(os.environ["HANGS"]))"""
"""Starts a process with a session and an environment of its own, whose parent has ended."""


@pytest.mark.slow
@pytest.mark.parametrize("end", [None, signal.SIGTERM, signal.SIGKILL])
@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no process that adopts")
def test_a_process_with_an_environment_of_its_own_ends_with_the_command(tmp_path, end):
    check_nothing_is_left(tmp_path, end, ORPHAN, 2)


@pytest.mark.slow
@pytest.mark.parametrize("end", [None, signal.SIGINT, signal.SIGKILL])
def test_a_cost_that_forks_leaves_no_process(tmp_path, end):
    check_nothing_is_left(tmp_path, end, FORKS, 11)


def check_nothing_is_left(tmp_path, end, code, least):
    """Run an examination, end it by a signal if there is one, and find no process in its folder."""
    (tmp_path / "mine.py").write_text(COST.format(end="pass").replace("if len(calls) == 11: pass", code))
    environment = INHERITED | {"HANGS": "600" if end else "0"}
    words = hearing_signals("examine", "mine.py:cost", "grad=grad", "calls=30", "--quiet")
    with subprocess.Popen(words, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL) as run:
        if end:
            wait_for(lambda: (tmp_path / "begun").exists())
            assert len(processes_in(tmp_path)) > least
            run.send_signal(end)
        run.wait(60)
    wait_for(lambda: not processes_in(tmp_path), 10.0)


@pytest.mark.slow
def test_processes_of_a_cost_find_its_file(tmp_path):
    (tmp_path / "pool.py").write_text(POOL)
    status, said = status_of(tmp_path, "examine", "pool.py:cost", "grad=grad", "calls=20")
    assert status == 0, said
    assert "Traceback" not in said


def test_a_theta_that_contains_itself_is_bad_input(tmp_path, capsys):
    (tmp_path / "pool.py").write_text(POOL)
    assert main(["examine", f"{tmp_path / 'pool.py'}:cost", "theta=loop", "grad=grad", "calls=20"]) == 2
    assert "contains itself" in capsys.readouterr().err


def test_a_file_named_like_a_library_is_loaded_beside_it(tmp_path):
    (tmp_path / "json.py").write_text("OWN = 1\n")
    assert load_module(str(tmp_path / "json.py")).OWN == 1
    assert json.dumps([1]) == "[1]"
    assert sys.modules["json"] is json


READ_BY_NOBODY = {
    "examine": ["examine", "c.py:cost", "grad=c.py:grad"],
    "report": ["report", "+experiment=quick", "formats=[]"],
    "compare": ["compare", "results/quick", "results/quick"],
}


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(words, id=name, marks=[pytest.mark.slow] * (name == "report"))
        for name, words in READ_BY_NOBODY.items()
    ],
)
def test_output_that_nobody_read_is_no_zero(tmp_path, words):
    """``examine ... | head -1`` under ``pipefail``: the wrong gradient ended with 0, and a report with 3."""
    (tmp_path / "c.py").write_text(COST.format(end="pass"))
    shutil.copytree(ROOT / "results/standard/quick", tmp_path / "results/quick")
    reading, writing = os.pipe()
    os.close(reading)
    try:
        command = [sys.executable, "-m", "bench", *words]
        said = subprocess.run(command, cwd=tmp_path, stdout=writing, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(writing)
    assert said.returncode == 141, said.stderr
    assert "bench:" not in said.stderr
