"""``python -m bench examine mysim.py:cost theta=1,0 ...``: parses the command line and runs the examination."""

from __future__ import annotations

import re
import shutil
import sys
import textwrap
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import StorageError, UserError, local_path, unknown
from bench.examine import ci
from bench.examine.examination import examine
from bench.examine.report import Report
from bench.model.simulator import imports
from bench.model.simulator.simulator import LIBRARIES

SETTINGS = (
    "theta", "grad", "sigma", "noise", "budget", "batch", "scale", "seed", "calls", "compile_budget", "tolerance", "atol",
    "allow_zero", "expect", "twin", "twin_grad", "refined", "horizons", "baseline", "save",
)  # fmt: skip
"""Settings of one cost."""
FILES = ("baseline", "save")
"""Files of one cost."""
OUTPUTS = ("markdown", "junit")
"""Files of a whole command."""
QUIET, MATRIX = "--quiet", "--matrix"
EXAMPLES = {
    "cost": "python -m bench examine FILE:NAME [theta=1,0] [grad=jax] [sigma=0.1]",
    "file": "python -m bench examine --matrix FILE.toml [markdown=FILE] [junit=FILE]",
}
WIDTH, LEAST_WIDTH = 100, 40
"""Width of the text without a terminal, and the least width, in characters."""


def run(words: Sequence[str]) -> Report:
    """Run the examination of a command line, print the report, save it if ``save=`` is given, and return it.

    Raises :class:`UserError` for a command line that cannot be parsed.
    """
    cost, settings = _parse(words, (*SETTINGS, *OUTPUTS))
    report = _examined(cost, {key: value for key, value in settings.items() if key in SETTINGS}, QUIET not in words)
    print(_wrapped(str(report)))
    _save(report, settings)
    _write(settings, [report], {})
    return report


def main(words: Sequence[str]) -> int:
    """Run the command, and return the exit status: 0 right, 1 wrong, 3 not decided; 2 is bad input."""
    if any(word.partition("=")[0] == MATRIX for word in words):
        return _run_matrix([word.removeprefix(f"{MATRIX}=") for word in words if word != MATRIX])
    status = run(words).status
    sys.stdout.flush()
    return status


def _parse(
    words: Sequence[str], allowed: Sequence[str], verb: str = "examine", one: str = "cost"
) -> tuple[str, dict[str, str]]:
    """Return the name of a cost or file, and its settings."""
    names = [word for word in words if "=" not in word and word != QUIET]
    if len(names) != 1:
        given = f", not {len(names)}" if names else ""
        raise UserError(f"name one {one}{given}: {EXAMPLES[one]}")
    settings = dict(word.split("=", 1) for word in words if "=" in word)
    for key in settings:
        if key not in allowed:
            raise unknown(f"setting of {verb}", key, allowed)
        if key in (*FILES, *OUTPUTS):
            local_path(key, settings[key])
    return names[0], settings


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


def _examined(cost: str, settings: Mapping[str, Any], progress: bool) -> Report:
    """Return the report on a cost ``FILE:NAME`` with settings as on the command line, or as in a TOML file."""
    function = imports.load_attribute(cost)
    module = imports.load_module(cost.rpartition(":")[0])
    if "theta" not in settings and not hasattr(module, "theta"):
        raise UserError("theta is missing: give theta=1,0 or define theta in the file")
    given = {key: value for key, value in {"theta": "theta", **settings}.items() if key not in FILES}
    values = {key: PARSERS.get(key, _as_it_is)(value, key, module) for key, value in given.items()}
    report = examine(function, name=cost, progress=progress, **values)
    words = " ".join(f"{key}={value}" for key, value in settings.items() if key != "expect")
    report = replace(report, command=f"python -m bench examine {cost} {words}".strip())
    return report.compared(settings["baseline"]) if "baseline" in settings else report


def _save(report: Report, settings: Mapping[str, Any]) -> None:
    if "save" in settings:
        print("\nWritten:")
        for path in report.save(settings["save"]):
            print(f"  {path}")


# ---------------------------------------------------------------------------------------------- many costs


def _run_matrix(words: Sequence[str]) -> int:
    """Examine every cost of a TOML file, print one table, and return the exit status."""
    file, outputs = _parse(words, OUTPUTS, "examine --matrix", "file")
    reports: list[Report] = []
    refused: dict[str, str] = {}
    for name, cost, settings in read_matrix(Path(file)):
        try:
            report = _examined(cost, settings, QUIET not in words)
        except UserError as error:
            refused[name] = str(error)
            print(f"{name}: bad input: {error}\n")
            continue
        report = replace(report, name=name)
        reports.append(report)
        print(_wrapped(str(report)) + "\n")
        _save(report, settings)
    print(ci.as_text(reports, refused))
    print(ci.as_line(reports, refused))
    _write(outputs, reports, refused)
    sys.stdout.flush()
    return ci.status(reports, refused)


def read_matrix(path: Path) -> list[tuple[str, str, dict[str, Any]]]:
    """Return name, cost and settings of each ``[[cost]]`` of a TOML file, completed by ``[defaults]``.

    Costs of files are relative to the TOML file. Raises :class:`UserError` for a file that is not such a table.
    """
    try:
        table = tomllib.loads(path.read_text())
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not TOML: {error}") from None
    defaults, costs = table.pop("defaults", {}), table.pop("cost", [])
    if table or not isinstance(defaults, dict) or not isinstance(costs, list) or not costs:
        extra = f" (unknown: {', '.join(table)})" if table else ""
        raise UserError(f"{path} needs one [[cost]] or more, and may have [defaults]{extra}")
    rows = []
    for index, one in enumerate(costs):
        settings = {**defaults, **one}
        cost = settings.pop("cost", None)
        if not isinstance(cost, str):
            raise UserError(f'{path}: [[cost]] number {index + 1} has no cost: write cost = "FILE:NAME"')
        name = str(settings.pop("name", cost))
        for key in settings:
            if key not in SETTINGS:
                raise unknown(f"setting of {name}:", key, SETTINGS)
        place, _, function = cost.rpartition(":")
        if place.endswith(".py"):
            cost = f"{path.parent / Path(place).expanduser()}:{function}"
        settings |= {key: str(path.parent / local_path(key, settings[key])) for key in FILES if key in settings}
        rows.append((name, cost, settings))
    return rows


def _write(outputs: Mapping[str, str], reports: Sequence[Report], refused: Mapping[str, str]) -> None:
    """Write the Markdown summary, appended as a CI server's summary file needs, and the JUnit file."""
    try:
        if "markdown" in outputs:
            with local_path("markdown", outputs["markdown"]).open("a") as file:
                file.write(ci.as_markdown(reports, refused))
        if "junit" in outputs:
            local_path("junit", outputs["junit"]).write_text(ci.as_junit(reports, refused))
    except OSError as error:
        raise StorageError(f"the summary cannot be written: {error}") from None


# ---------------------------------------------------------------------------------------------- values


def _as_it_is(given: Any, key: str, module: Any) -> Any:
    return given


def _numbers(given: Any, key: str) -> list[float]:
    try:
        parts = given.strip("[]() ").split(",") if isinstance(given, str) else np.ravel(given)
        return [float(part) for part in parts if str(part).strip()]
    except (TypeError, ValueError):
        raise UserError(f"{key}={given} is not a list of numbers: write {key}=1,0.5") from None


def _count(given: Any, key: str, module: Any) -> int:
    if not re.fullmatch(r"\d+", str(given)):
        raise UserError(f"{key}={given} is not a whole number")
    return int(given)


def _counts(given: Any, key: str, module: Any) -> list[int]:
    return [int(one) for one in _numbers(given, key)]


def _by_input(given: Any, key: str, module: Any) -> Any:
    """Return numbers, or a mapping of inputs to numbers, from ``name:number,name:number``."""
    if isinstance(given, Mapping):
        return dict(given)
    pairs = re.findall(r"([A-Za-z_][\w.\[\]]*):([^,]+)", given) if isinstance(given, str) else []
    if pairs and len(pairs) == given.count(",") + 1:
        return {name: _numbers(value, name)[0] for name, value in pairs}
    return np.array(_numbers(given, key)) if isinstance(given, str) else np.array(given, dtype=np.float64)


def _one_by_input(given: Any, key: str, module: Any) -> Any:
    values = _by_input(given, key, module)
    if not isinstance(values, dict) and values.size != 1:
        raise UserError(f"{key}={given} is not valid: write one number, or {key}=mass:1e-3,gain:1e-2")
    return values if isinstance(values, dict) else float(values.ravel()[0])


def _names(given: Any, key: str, module: Any) -> Any:
    if isinstance(given, str):
        words = {"true": True, "false": False}
        return words.get(given.lower(), [name.strip() for name in given.split(",") if name.strip()])
    return given if isinstance(given, bool) else [str(name) for name in given]


def _theta(given: Any, key: str, module: Any) -> Any:
    """Return theta from numbers, ``name:number`` pairs, or a name in the file, called if it is a function."""
    if not (isinstance(given, str) and re.fullmatch(r"[A-Za-z_][\w.]*", given)):
        return _by_input(given, key, module)
    theta = imports.load_attribute(given, module, "theta")
    return theta() if callable(theta) else theta


def _function(given: Any, key: str, module: Any) -> Any:
    return imports.load_attribute(str(given), module, key)


def _gradient(given: Any, key: str, module: Any) -> Any:
    return given if given in LIBRARIES else imports.load_attribute(str(given), module, "grad", LIBRARIES)


PARSERS: dict[str, Callable[[Any, str, Any], Any]] = {
    "theta": _theta, "scale": _theta, "grad": _gradient, "twin_grad": _gradient, "twin": _function, "refined": _function,
    "sigma": _by_input, "tolerance": _one_by_input, "atol": _one_by_input, "allow_zero": _names, "horizons": _counts,
    "noise": _count, "seed": _count, "calls": _count,
}  # fmt: skip
"""How the settings are read whose values are not taken as they are."""
