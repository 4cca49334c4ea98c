"""A copy of the code that plugins can be added to and files edited in."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


class Tree:
    """A copy of the code that plugins can be added to, and commands run in."""

    def __init__(self, root: Path) -> None:
        self.root, self.packages = root / "tree", root / "site"
        for part in ("bench", "plugins", "conf"):
            shutil.copytree(ROOT / part, self.root / part, ignore=shutil.ignore_patterns("__pycache__"))
        self.packages.mkdir()

    def add(self, path: str, text: str) -> None:
        """A file in the tree."""
        (self.root / path).write_text(text)

    def install(self, package: str, text: str, entry_points: str) -> None:
        """What ``pip install`` does to a package of one module: its code, and metadata that names its entry points."""
        (self.packages / f"{package}.py").write_text(text)
        information = self.packages / f"{package}-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(entry_points)

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """``python -m bench`` with these words."""
        environment = {**os.environ, "PYTHONPATH": str(self.packages), "PYTHONDONTWRITEBYTECODE": "1"}
        return subprocess.run(
            [sys.executable, "-m", "bench", *words], cwd=self.root, env=environment, capture_output=True, text=True
        )


HEARD = """
import os, signal, sys
for name in ("SIGINT", "SIGTERM", "SIGHUP"):
    signal.signal(getattr(signal, name), signal.SIG_DFL)
os.execv(sys.argv[1], sys.argv[1:])
"""


def hearing_signals(*words: str) -> list[str]:
    """``python -m bench`` with these words, as a command that hears signals.

    A shell ignores interrupts in its background jobs and nohup hang-ups, and what they start inherits that.
    """
    return [sys.executable, "-c", HEARD, sys.executable, "-m", "bench", *words]
