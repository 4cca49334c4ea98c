"""``python -m bench examine mysim.py:cost theta=1,0 ...``: parses the command line and runs the examination."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import StorageError, UserError, local_path, needing_sweeps, unknown
from bench.examine import UPDATE
from bench.examine.baseline import read_baseline
from bench.examine.examination import KEY, examine
from bench.examine.report import Report
from bench.run.files import make_directory
from bench.simulator import imports
from bench.simulator.simulator import LIBRARIES

FILES = ("baseline", "save")
"""Files of one cost."""
SETTINGS = [name for name in inspect.signature(examine).parameters if name not in ("cost", "name", "progress")] + [
    *FILES
]
"""Settings of one cost."""
QUIET = "--quiet"
COMPILED = Path("~/.cache/diffsim-bench/jax").expanduser()
"""Folder of programs that JAX has compiled, as a simulator may compile for minutes."""


def run(words: Sequence[str]) -> Report:
    """Run the examination of a command line, print the report, save it if ``save=`` is given, and return it.

    Raises :class:`UserError` for a command line that cannot be parsed.
    """
    names = [word for word in words if "=" not in word and word not in (QUIET, UPDATE)]
    if len(names) != 1:
        given = f", not {len(names)}" if names else ""
        raise UserError(f"name one cost{given}: python -m bench examine FILE:NAME [theta=1,0] [grad=jax] [sigma=0.1]")
    settings = dict(word.split("=", 1) for word in words if "=" in word)
    for key in settings:
        if key not in SETTINGS:
            raise unknown("setting of examine", key, SETTINGS)
    _check_files(settings)
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(COMPILED))  # which JAX reads when it is imported
    report = _examined(names[0], settings, QUIET not in words)
    if "baseline" in settings:
        report = report.compared(settings["baseline"], UPDATE in words)
    print(report)
    if "save" in settings:
        print("\nWritten:")
        for path in report.save(settings["save"]):
            print(f"  {path}")
    return report


def _check_files(settings: Mapping[str, str]) -> None:
    """Raise the error of a file that cannot be read or written, before an examination that may take minutes."""
    if "baseline" in settings:
        read_baseline(local_path("baseline", settings["baseline"]))
    if "save" in settings:
        with needing_sweeps("save"):
            import bench.examine.files  # noqa: F401

        directory = local_path("save", settings["save"])
        make_directory(directory)
        if not os.access(directory, os.W_OK):
            raise StorageError(f"save={directory} cannot be written: permission denied")


def main(words: Sequence[str]) -> int:
    """Run the command, and return the exit status: 0 right, 1 wrong, 3 not decided; 2 is bad input."""
    return run(words).status


def _examined(cost: str, settings: Mapping[str, str], progress: bool) -> Report:
    """Return the report on a cost ``FILE:NAME`` with settings as on the command line."""
    function = imports.load_attribute(cost)
    module = imports.load_module(cost.rpartition(":")[0])
    if "theta" not in settings and not hasattr(module, "theta"):
        raise UserError("theta is missing: give theta=1,0 or define theta in the file")
    given = {key: value for key, value in {"theta": "theta", **settings}.items() if key not in FILES}
    values = {key: _value(key, value, module) for key, value in given.items()}
    report = examine(function, name=cost, progress=progress, **values)
    words = " ".join(f"{key}={value}" for key, value in settings.items() if key != "expect")
    return replace(report, command=f"python -m bench examine {cost} {words}".strip())


def _value(key: str, given: str, module: Any) -> Any:
    """Return the value of a setting: a function or theta of the file by its name, or numbers, also as ``name:number`` pairs."""
    match key:
        case "grad" | "refined":
            libraries = LIBRARIES if key == "grad" else ()
            return given if given in libraries else imports.load_attribute(given, module, key, libraries)
        case "theta" | "scale" if re.fullmatch(r"[A-Za-z_][\w.]*", given):
            theta = imports.load_attribute(given, module, "theta")
            return theta() if callable(theta) else theta
        case "noise" if given == KEY:
            return given
        case "noise" | "seed" | "calls":
            if not re.fullmatch(r"\d+", given):
                raise UserError(f"{key}={given} is not a whole number of at least {int(key == 'calls')}")
            return int(given)
        case "allow_zero":
            words = {"true": True, "false": False}
            return words.get(given.lower(), [name.strip() for name in given.split(",") if name.strip()])
        case "theta" | "scale" | "sigma" | "tolerance" | "atol" | "horizons":
            pairs = re.findall(r"([A-Za-z_][\w.\[\]]*):([^,]+)", given)
            if pairs and len(pairs) == given.count(",") + 1:
                return {name: _numbers(name, value)[0] for name, value in pairs}
            numbers = _numbers(key, given)
            return numbers[0] if len(numbers) == 1 and key not in ("theta", "horizons") else np.array(numbers)
    return given


def _numbers(key: str, given: str) -> list[float]:
    with suppress(ValueError):
        if numbers := [float(part) for part in given.strip("[]() ").split(",") if part.strip()]:
            return numbers
    raise UserError(f"{key}={given} is not a list of numbers: write {key}=1,0.5")
