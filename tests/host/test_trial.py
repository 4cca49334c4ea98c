"""A plugin file that ends the process that imports it is listed, and ends nothing else."""

import subprocess
import sys
from types import ModuleType

import numpy as np
import pytest
from trees import INHERITED, bench

from bench.errors import FOLDER, UserError, failure, printable
from bench.host import guard, registry, trial

GOOD = "from bench.model import SampleMean\n"
FATAL = {
    "exits": ("import os\nos._exit(0)\n", "ended the process (exit status 0)"),
    "crashes": ("import ctypes\nctypes.string_at(0)\n", "ended the process by SIGSEGV when it was imported"),
    "patches": ("import numpy\nnumpy.sqrt = numpy.cbrt\n", "replaced numpy.sqrt when it was imported"),
    "hides": ("import sys\nsys.modules['json'] = None\n", "replaced json when it was imported"),
}
ODD = "from bench.model import SampleMean\nclass Odd(SampleMean):\n    name = 'odd'\n    requires = None\n"


@pytest.fixture(autouse=True)
def untried():
    """Here files are tried."""


@pytest.fixture
def folder(tmp_path):
    """A folder of plugins."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "good.py").write_text(GOOD)
    return tmp_path / "mine"


def fatal(folder, names, patience=60.0):
    package = registry._package(folder)
    return trial.find_fatal_modules([f"{package}.{name}" for name in names], {package: folder}, patience)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_listed_with_what_happened_and_the_others_are_listed_too(folder):
    for name, (text, _) in FATAL.items():
        (folder / f"{name}.py").write_text(text)
    (folder / "forks.py").write_text("import os\nos.fork()\n")
    for name in ("odd_one", "odd_two"):
        (folder / f"{name}.py").write_text(ODD)
    (folder / "waits.py").write_text(
        "import threading, time\nthreading.Thread(target=time.sleep, args=(600,)).start()\n"
    )
    done = bench("list", "estimators", f"plugins={folder}")  # waits for no thread
    assert done.returncode == 0, done.stderr
    for name, (_, said) in FATAL.items():
        (line,) = [line for line in done.stdout.splitlines() if line.startswith(f"  {name} ")]
        assert "UNAVAILABLE" in line
        assert said in line
    assert done.stdout.count("  fobg ") == 1  # a forked copy does not go on
    for name in ("odd_one", "odd_two"):  # their classes are called alike
        assert f"{name}.Odd" in done.stdout


def test_a_plugin_may_raise_the_recursion_limit_and_not_lower_it():
    before = sys.getrecursionlimit()
    with guard.protect_process():
        sys.setrecursionlimit(before - 100)
    assert sys.getrecursionlimit() == before
    with guard.protect_process():
        sys.setrecursionlimit(before + 100)
    assert sys.getrecursionlimit() == before + 100
    sys.setrecursionlimit(before)


def test_a_function_that_a_plugin_replaces_while_cells_are_planned_ends_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, f"{FOLDER}0.mine", ModuleType("mine"))
    with pytest.raises(UserError, match=r"a plugin has replaced numpy\.sqrt"), guard.contained():
        monkeypatch.setattr(np, "sqrt", np.cbrt)


@pytest.mark.slow
def test_an_import_that_does_not_come_back(folder):
    (folder / "hangs.py").write_text("import time\nprint('x' * 100000)\nwhile True: time.sleep(1)\n")
    (folder / "raises.py").write_text("1 / 0\n")
    found = fatal(folder, ["good", "hangs", "raises"], patience=3.0)
    assert {name.rpartition(".")[2]: said for name, said in found.items()} == {
        "hangs": "did not return within 3 s when it was imported"
    }


def test_a_plugin_at_work_moves_no_command_to_another_folder(tmp_path):
    """In a process of its own, since this one has threads, and must not fork."""
    code = """if True:
        import os, sys
        from bench.host import guard
        before, own, path = os.getcwd(), os.getpid(), [*sys.path]
        with guard.protect_process():
            os.chdir("/")
            sys.path[:] = ["new"]
        assert os.getcwd() == before
        assert sys.path == [*path, "new"]
        with guard.protect_process():
            os.fork()
        assert os.getpid() == own  # the copy has ended
        assert os.wait()[1] == 0
        print("both")
    """
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=INHERITED, capture_output=True, text=True)
    assert done.stdout == "both\n", done.stderr


LOUD = '''
"""Prints whatever is done with it."""

import os, subprocess, warnings
from dataclasses import dataclass
from bench.plugins.estimators.fobg import Fobg

print("\\x1b[31mred at import", flush=True)
os.write(2, b"\\x1b]0;title\\x07 " + b"y" * 100000)
subprocess.Popen(["echo", "from a child"]).wait()
warnings.warn("loudly")

@dataclass(frozen=True)
class Loud(Fobg):
    "Prints when it is made."
    name = "loud"
    def __post_init__(self):
        print("made\\x1b[2J")
    def refusal(self, *given):
        print("asked\\x07")
        return super().refusal(*given)
'''


@pytest.mark.slow
def test_what_plugins_print_reaches_no_terminal_raw(tmp_path):
    (tmp_path / "loud.py").write_text(LOUD)
    place = f"plugins={tmp_path}"
    words = ["estimators=[loud]", "scenes=[heaviside]", "backends=[numpy]", place, f"results_dir={tmp_path}"]
    for verb in (["list", place], ["plan", *words]):
        done = bench(*verb, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        assert not [c for c in done.stdout + done.stderr if ord(c) < 32 and c != "\n"]
        assert "loud, while it was imported, printed: [31mred at import" in done.stderr
        assert max(map(len, done.stderr.splitlines())) < 500
        assert "red at import" not in done.stdout
    assert "estimator loud printed: made [2J" in done.stderr
    assert "asked" in done.stderr


def test_an_error_that_cannot_be_printed_is_one_of_its_plugin():
    silent = type("Silent", (Exception,), {"__str__": lambda self: sys.exit(0)})()
    assert printable(silent) == "(a message that cannot be printed)"
    assert "Silent: (a message" in failure(silent)["reason"]
