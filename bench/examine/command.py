"""``python -m bench examine mysim.py:cost theta=1,0 ...``: parses the command line and runs the examination."""

from __future__ import annotations

import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bench.errors import StorageError, UserError, local_path, unknown
from bench.examine.examination import examine
from bench.examine.report import Report
from bench.run.files import make_directory
from bench.simulator import imports
from bench.simulator.simulator import LIBRARIES

SETTINGS = (
    "theta", "grad", "sigma", "noise", "budget", "batch", "scale", "seed", "calls", "compile_budget", "tolerance", "atol",
    "allow_zero", "expect", "refined", "horizons", "baseline", "save",
)  # fmt: skip
"""Settings of one cost."""
FILES = ("baseline", "save")
"""Files of one cost."""
QUIET = "--quiet"
WIDTH, LEAST_WIDTH = 100, 40
"""Width of the text without a terminal, and the least width, in characters."""


def run(words: Sequence[str]) -> Report:
    """Run the examination of a command line, print the report, save it if ``save=`` is given, and return it.

    Raises :class:`UserError` for a command line that cannot be parsed.
    """
    names = [word for word in words if "=" not in word and word != QUIET]
    if len(names) != 1:
        given = f", not {len(names)}" if names else ""
        raise UserError(f"name one cost{given}: python -m bench examine FILE:NAME [theta=1,0] [grad=jax] [sigma=0.1]")
    settings = dict(word.split("=", 1) for word in words if "=" in word)
    for key in settings:
        if key not in SETTINGS:
            raise unknown("setting of examine", key, SETTINGS)
        if key in FILES:
            local_path(key, settings[key])
    report = _examined(names[0], settings, QUIET not in words)
    print(_wrapped(str(report)))
    if "save" in settings:
        print("\nWritten:")
        for path in report.save(settings["save"]):
            print(f"  {path}")
    return report


def main(words: Sequence[str]) -> int:
    """Run the command, and return the exit status: 0 right, 1 wrong, 3 not decided; 2 is bad input."""
    status = run(words).status
    sys.stdout.flush()
    return status


def _wrapped(text: str) -> str:
    """Return text with its sentences wrapped to the width of the terminal; rows of tables and commands stay whole."""
    width = max(shutil.get_terminal_size((WIDTH, 0)).columns, LEAST_WIDTH)
    lines = []
    for line in text.splitlines():
        bare = line.lstrip()
        if len(line) <= width or "  " in bare or "python -m bench " in bare:
            lines.append(line)
        else:
            indent = " " * (len(line) - len(bare) + 2)
            lines += textwrap.wrap(
                line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
            )
    return "\n".join(lines)


def _examined(cost: str, settings: Mapping[str, str], progress: bool) -> Report:
    """Return the report on a cost ``FILE:NAME`` with settings as on the command line."""
    function = imports.load_attribute(cost)
    module = imports.load_module(cost.rpartition(":")[0])
    if "theta" not in settings and not hasattr(module, "theta"):
        raise UserError("theta is missing: give theta=1,0 or define theta in the file")
    given = {key: value for key, value in {"theta": "theta", **settings}.items() if key not in FILES}
    values: dict[str, Any] = {
        key: PARSERS[key](value, key, module) if key in PARSERS else value for key, value in given.items()
    }
    if "save" in settings:  # a folder that cannot be written is an error before the examination, not after it
        make_directory(folder := local_path("save", settings["save"]))
        if not os.access(folder, os.W_OK):
            raise StorageError(f"save={folder} cannot be written: it is read-only")
    report = examine(function, name=cost, progress=progress, **values)
    words = " ".join(f"{key}={value}" for key, value in settings.items() if key != "expect")
    report = replace(report, command=f"python -m bench examine {cost} {words}".strip())
    return report.compared(settings["baseline"]) if "baseline" in settings else report


# ---------------------------------------------------------------------------------------------- values


def _numbers(given: str, key: str) -> list[float]:
    try:
        return [float(part) for part in given.strip("[]() ").split(",") if part.strip()]
    except ValueError:
        raise UserError(f"{key}={given} is not a list of numbers: write {key}=1,0.5") from None


def _count(given: str, key: str, module: Any) -> int:
    if not re.fullmatch(r"\d+", given):
        raise UserError(f"{key}={given} is not a whole number")
    return int(given)


def _counts(given: str, key: str, module: Any) -> list[int]:
    return [int(one) for one in _numbers(given, key)]


def _by_input(given: str, key: str, module: Any) -> Any:
    """Return numbers, or a mapping of inputs to numbers, from ``name:number,name:number``."""
    pairs = re.findall(r"([A-Za-z_][\w.\[\]]*):([^,]+)", given)
    if pairs and len(pairs) == given.count(",") + 1:
        return {name: _numbers(value, name)[0] for name, value in pairs}
    return np.array(_numbers(given, key))


def _one_by_input(given: str, key: str, module: Any) -> Any:
    values = _by_input(given, key, module)
    if not isinstance(values, dict) and values.size != 1:
        raise UserError(f"{key}={given} is not valid: write one number, or {key}=mass:1e-3,gain:1e-2")
    return values if isinstance(values, dict) else float(values[0])


def _names(given: str, key: str, module: Any) -> Any:
    words = {"true": True, "false": False}
    return words.get(given.lower(), [name.strip() for name in given.split(",") if name.strip()])


def _theta(given: str, key: str, module: Any) -> Any:
    """Return theta from numbers, ``name:number`` pairs, or a name in the file, called if it is a function."""
    if not re.fullmatch(r"[A-Za-z_][\w.]*", given):
        return _by_input(given, key, module)
    theta = imports.load_attribute(given, module, "theta")
    return theta() if callable(theta) else theta


def _function(given: str, key: str, module: Any) -> Any:
    return imports.load_attribute(given, module, key)


def _gradient(given: str, key: str, module: Any) -> Any:
    return given if given in LIBRARIES else imports.load_attribute(given, module, "grad", LIBRARIES)


PARSERS: dict[str, Callable[[str, str, Any], Any]] = {
    "theta": _theta, "scale": _theta, "grad": _gradient, "refined": _function,
    "sigma": _by_input, "tolerance": _one_by_input, "atol": _one_by_input, "allow_zero": _names, "horizons": _counts,
    "noise": _count, "seed": _count, "calls": _count,
}  # fmt: skip
"""How the settings are read whose values are not taken as they are."""
