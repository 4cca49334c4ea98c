"""``python -m bench examine mysim.py:cost theta=1,0 ...``: parses the command line and runs the examination."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from bench.errors import UserError, unknown
from bench.examine.examination import examine
from bench.examine.report import Report
from bench.model.simulator import imports
from bench.model.simulator.simulator import LIBRARIES

SETTINGS = ("theta", "grad", "sigma", "noise", "budget", "batch", "scale", "seed", "save")
QUIET = "--quiet"


def run(words: Sequence[str]) -> Report:
    """Run the examination of a command line, print the report, save it if ``save=`` is given, and return it.

    Raises :class:`UserError` for a command line that cannot be parsed.
    """
    costs = [word for word in words if "=" not in word and word != QUIET]
    if len(costs) != 1:
        given = f", not {len(costs)}" if costs else ""
        raise UserError(f"name one cost{given}: python -m bench examine FILE:NAME [theta=1,0] [grad=jax] [sigma=0.1]")
    settings: dict[str, str] = {}
    for word in words:
        if "=" in word:
            key, _, value = word.partition("=")
            if key not in SETTINGS:
                raise unknown("setting of examine", key, SETTINGS)
            settings[key] = value
    file = costs[0].rpartition(":")[0]
    cost = imports.load_attribute(costs[0])
    module = imports.load_module(file)
    report = examine(
        cost,
        _theta(settings.get("theta", "theta"), module, "theta" in settings),
        grad=_gradient(settings.get("grad"), module),
        sigma=_numbers(settings["sigma"], "sigma") if "sigma" in settings else (),
        noise=_count(settings, "noise"),
        budget=settings.get("budget", "60s"),
        batch=settings.get("batch"),
        scale=_theta(settings["scale"], module, True) if "scale" in settings else None,
        seed=_count(settings, "seed"),
        name=costs[0],
        progress=QUIET not in words,
    )
    print(report)
    if "save" in settings:
        print("\nWritten:")
        for path in report.save(settings["save"]):
            print(f"  {path}")
    return report


def main(words: Sequence[str]) -> int:
    """Run the command, and return the exit status."""
    report = run(words)
    sys.stdout.flush()
    return report.status


def _numbers(text: str, what: str) -> list[float]:
    try:
        return [float(part) for part in text.strip("[]() ").split(",") if part.strip()]
    except ValueError:
        raise UserError(f"{what}={text} is not a list of numbers: write {what}=1,0.5") from None


def _count(settings: dict[str, str], key: str) -> int:
    text = settings.get(key, "0")
    if not re.fullmatch(r"\d+", text):
        raise UserError(f"{key}={text} is not a whole number")
    return int(text)


def _theta(text: str, module: Any, given: bool) -> Any:
    """Return theta from numbers, ``name:number`` pairs, or a name in the file, called if it is a function."""
    if re.fullmatch(r"[A-Za-z_][\w.]*", text):
        if not given and not hasattr(module, text):
            raise UserError("theta is missing: give theta=1,0 or define theta in the file")
        theta = imports.load_attribute(text, module)
        return theta() if callable(theta) else theta
    pairs = re.findall(r"([A-Za-z_]\w*):([^,]+)", text)
    if pairs and len(pairs) == text.count(",") + 1:
        return {name: _numbers(value, name)[0] for name, value in pairs}
    return np.array(_numbers(text, "theta"))


def _gradient(text: str | None, module: Any) -> Any:
    if text is None or text in LIBRARIES:
        return text
    if ":" not in text and not hasattr(module, text):
        names = [name for name, value in vars(module).items() if callable(value) and not name.startswith("_")]
        raise unknown("grad", text, (*LIBRARIES, *names))
    return imports.load_attribute(text, module)
