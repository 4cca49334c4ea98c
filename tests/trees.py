"""Commands that run in a copy of the code, or with default signal handlers."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[1]


class Tree:
    """A copy of the code, in which tests add plugins, edit files and run commands."""

    def __init__(self, root):
        self.root, self.packages = root / "tree", root / "site"
        for part in ("bench", "plugins", "conf"):
            shutil.copytree(ROOT / part, self.root / part)  # with the bytecode, which an edit of its file makes void
        self.packages.mkdir()

    def add(self, path, text):
        """Write a file of the copy, at a path relative to its root."""
        (self.root / path).write_text(text)

    def install(self, package, text, entry_points):
        """Install a package of one module as ``pip install`` does: its code, and metadata with its entry points."""
        (self.packages / f"{package}.py").write_text(text)
        information = self.packages / f"{package}-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(entry_points)

    def run(self, *words):
        """Run ``python -m bench`` with these arguments in the copy."""
        environment = {**os.environ, "PYTHONPATH": str(self.packages), "PYTHONDONTWRITEBYTECODE": "1"}
        return subprocess.run(
            [sys.executable, "-m", "bench", *words], cwd=self.root, env=environment, capture_output=True, text=True
        )


INHERITED = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, sys.path))}
"""The environment of commands in another folder."""


def bench(*words, folder=None):
    """Run ``python -m bench`` with these arguments in a folder."""
    command = [sys.executable, "-m", "bench", *map(str, words)]
    return subprocess.run(command, cwd=folder, env=INHERITED, capture_output=True, text=True, timeout=500)


DEFAULT_SIGNALS = """
import os, signal, sys
for name in ("SIGINT", "SIGTERM", "SIGHUP"):
    signal.signal(getattr(signal, name), signal.SIG_DFL)
os.execv(sys.argv[1], sys.argv[1:])
"""


def hearing_signals(*words):
    """Return the command line of ``python -m bench`` with default signal handlers.

    A shell ignores SIGINT in background jobs, nohup ignores SIGHUP, and child processes inherit ignored signals.
    """
    return [sys.executable, "-c", DEFAULT_SIGNALS, sys.executable, "-m", "bench", *words]


def processes_in(folder):
    """Return the processes that were started in a folder and have not ended."""
    found = []
    for process in psutil.process_iter():
        try:
            if Path(process.cwd()).is_relative_to(folder) and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except psutil.Error:
            continue
    return found


def wait_for(condition, seconds=60.0):
    """Wait until a condition holds."""
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.05)
