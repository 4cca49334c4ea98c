"""Registers checks, and runs them on plugins."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from bench import registry
from bench.contracts import Plugin


@dataclass(frozen=True)
class Result:
    """The outcome of one check: ``pass``, ``fail`` or ``skip``, and what was measured or why."""

    plugin: str
    check: str
    outcome: str
    detail: str = ""


class Failed(Exception):
    """What a plugin declares and what it does differ."""


class Skipped(Exception):
    """The check does not apply to the plugin."""


Check = Callable[[Any], str]
_CHECKS: dict[type[Plugin], list[Check]] = {}


def verifies(kind: type[Plugin]) -> Callable[[Check], Check]:
    """Register a check for the plugins of a kind."""

    def register(function: Check) -> Check:
        _CHECKS.setdefault(kind, []).append(function)
        return function

    return register


def require(condition: Any, message: str) -> None:
    """Raise :class:`Failed` unless the condition holds."""
    if not condition:
        raise Failed(message)


def main(names: Sequence[str]) -> int:
    """Check the plugins of those names, or all, and print a line for each check; the exit status."""
    started = time.perf_counter()
    tally = dict.fromkeys(("pass", "fail", "skip"), 0)
    plugins = 0
    for entry in (e for table in registry.entries().values() for e in table.values()):
        if names and entry.name not in names:
            continue
        plugins += 1
        if entry.plugin is None or not entry.available:
            results = [Result(entry.name, "available", "fail" if names else "skip", entry.reason)]
        else:
            results = check(entry.plugin)
        for result in results:
            tally[result.outcome] += 1
            print(f"{result.outcome}  {result.plugin:<38} {result.check:<38} {result.detail}", flush=True)
    seconds = time.perf_counter() - started
    counts = f"{tally['pass']} passed, {tally['fail']} failed, {tally['skip']} skipped"
    print(f"\n{plugins} plugin{'s' * (plugins != 1)}, {sum(tally.values())} checks: {counts} in {seconds:.1f} s")
    return 1 if tally["fail"] else 0


def check(plugin_class: type[Plugin]) -> list[Result]:
    """Every check that applies to a plugin class, with its default parameters and with each other choice it offers."""
    results = [_outcome(function, plugin_class, plugin_class.name) for function in _CHECKS[Plugin]]
    own: list[Result] = []
    try:
        instances = variants(plugin_class)
    except Exception as error:
        return [*results, Result(plugin_class.name, "builds", "fail", f"{type(error).__name__}: {error}")]
    for identity, plugin in instances.items():
        for kind, functions in _CHECKS.items():
            if kind is not Plugin and isinstance(plugin, kind):
                own.extend(_outcome(function, plugin, identity) for function in functions)
    if all(result.outcome == "skip" for result in own):
        own.append(Result(plugin_class.name, "something_was_checked", "fail", "every check of its kind was skipped"))
    return results + own


def variants(plugin_class: type[Plugin]) -> dict[str, Plugin]:
    """By identity: the default instance, and one for every other choice of a text or switch parameter but ``dtype``."""
    found = {plugin_class.name: registry.build(plugin_class, {})}
    for name, parameter in registry.parameters(plugin_class).items():
        choices = (True, False) if parameter.type is bool else parameter.choices or ()
        for choice in choices:
            if choice != parameter.default and name != "dtype":
                values = {name: choice}
                found[registry.identity(plugin_class.name, values)] = registry.build(plugin_class, values)
    return found


def _outcome(function: Check, subject: Any, identity: str) -> Result:
    try:
        outcome, detail = "pass", function(subject)
    except Skipped as reason:
        outcome, detail = "skip", str(reason)
    except Failed as reason:
        outcome, detail = "fail", str(reason)
    except Exception as error:
        outcome, detail = "fail", f"{type(error).__name__}: {error}"
    return Result(identity, function.__name__, outcome, " ".join(detail.split()))
