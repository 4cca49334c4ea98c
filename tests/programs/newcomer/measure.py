"""Times the first steps of a new user: a fresh environment, the installation, and a first script.

    python tests/programs/newcomer/measure.py KIND ...

creates an environment per kind in a temporary folder, installs this checkout with the kind's requirements, runs the kind's
script, and prints a line of seconds and numbers of lines. The scripts beside this file are first attempts of a new user. pip
needs access to a package index.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
NEEDS = {
    "numpy_loop": ["-e", "."],
    "jax_function": ["-e", ".[jax]"],
    "torch_module": ["torch==2.13.0", "-e", ".[torch]"],
    "warp_kernel": ["-e", ".", "warp-lang"],
    "gym_env": ["-e", ".", "gymnasium"],
}
"""Packages that pip installs, by kind of simulator."""


def main(kinds: list[str]) -> None:
    """Print a line per kind."""
    print("| kind | installed | report | lines | exit |\n|---|---|---|---|---|")
    for kind in kinds or NEEDS:
        script = HERE / f"{kind}.py"
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            venv.create(folder, with_pip=True)
            python = f"{folder}/bin/python"
            pip = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-c", "constraints.txt"]
            subprocess.run([*pip, *NEEDS[kind]], cwd=ROOT, check=True)
            installed = time.perf_counter()
            status = subprocess.run([python, str(script)], stdout=subprocess.DEVNULL).returncode
            ended = time.perf_counter()
        lines = sum(bool(line.strip()) for line in script.read_text().splitlines())
        print(f"| {kind} | {installed - began:.0f} s | {ended - installed:.1f} s | {lines} | {status} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
