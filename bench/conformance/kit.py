"""Registers checks, and runs them on plugins. Outcomes are printed lines, a list of results, or pytest tests."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from bench.engines.backend import EngineBackend
from bench.engines.process import close_engines
from bench.errors import failure, printable, unknown
from bench.model import Plugin, registry
from bench.model.identity import identity
from bench.model.parameters import build, parameters
from bench.simulator.clock import Clock, OutOfTime


@dataclass(frozen=True)
class CheckResult:
    """The outcome of one check: ``pass``, ``fail`` or ``skip``, with the measured numbers or the reason."""

    plugin: str
    check: str
    outcome: str
    detail: str = ""


class Failed(Exception):
    """Raised when a plugin's behaviour differs from its declaration."""


class Skipped(Exception):
    """Raised when a check does not apply to the plugin."""


Check = Callable[[Any], str]
LIMIT_S = 900.0
"""Default time limit of a check. The longest of the built-in plugins' checks take minutes."""
GRACE_S = 30.0
"""Time after the limit in which compiled code may return, before the process ends."""
_CHECKS: dict[type[Plugin], list[Check]] = {}


def verifies(kind: type[Plugin]) -> Callable[[Check], Check]:
    """Return a decorator that registers a check for plugins of one kind."""

    def register(function: Check) -> Check:
        _CHECKS.setdefault(kind, []).append(function)
        return function

    return register


def require(condition: Any, message: str) -> None:
    """Raise :class:`Failed` unless the condition holds."""
    if not condition:
        raise Failed(message)


def main(names: Sequence[str], limit: float = LIMIT_S) -> int:
    """Check the named plugins, or all of them, print a line per check, and return the exit status.

    A check that is not finished within ``limit`` seconds fails. On a terminal, a line shows the running check.
    """
    started = time.perf_counter()
    tally = dict.fromkeys(("pass", "fail", "skip"), 0)
    plugins = 0
    for entry in (e for table in registry.entries().values() for e in table.values()):
        if names and entry.name not in names:
            continue
        plugins += 1
        plugin = entry.plugin if entry.available else None
        reason = entry.reason if plugin is None else missing_environment(plugin)
        if plugin is None or reason:
            results = iter([CheckResult(entry.name, "available", "fail" if names else "skip", reason or "")])
        else:
            results = _results(plugin, limit=limit)
        last = ""
        for result in results:
            tally[result.outcome] += 1
            detail = "as above" if result.outcome == "fail" and result.detail == last else result.detail
            last = result.detail
            print(f"{result.outcome}  {result.plugin:<38} {result.check:<38} {detail}", flush=True)
    print(
        f"\n{plugins} plugin{'s' * (plugins != 1)}, {sum(tally.values())} checks: {tally['pass']} passed, "
        f"{tally['fail']} failed, {tally['skip']} skipped in {time.perf_counter() - started:.1f} s"
    )
    return 1 if tally["fail"] else 0


def check(plugin_class: type[Plugin], only: Collection[str] = ()) -> list[CheckResult]:
    """Return the results of a plugin class's checks, with default parameters and with each other choice it offers.

    ``only`` contains the names of the checks to run; empty runs all.
    """
    return list(_results(plugin_class, only))


def _results(
    plugin_class: type[Plugin], only: Collection[str] = (), limit: float | None = None
) -> Iterator[CheckResult]:
    """Yield the results of :func:`check` one by one; with a limit [s], checks that reach it fail and progress is shown."""
    items = [item for item in _items(plugin_class) if not only or item[2].__name__ in only]
    shows = limit is not None and sys.stderr.isatty()
    for index, (name, subject, function) in enumerate(items):
        if shows:
            _show(f"\r\033[Kcheck {index + 1} of {len(items)}: {name} {function.__name__}")
        started = time.perf_counter()
        try:
            with _time_limit(limit, f"fail  {name} {function.__name__}") if limit else contextlib.nullcontext():
                result = _outcome(function, subject, name)
        except OutOfTime:
            close_engines()  # an interrupted call leaves its answer in the pipe
            text = (
                f"not finished within {limit:g} s (limit=DURATION), stopped after {time.perf_counter() - started:.1f} s"
            )
            result = CheckResult(name, function.__name__, "fail", text)
        if shows:
            _show("\r\033[K")
        if result.check != something_was_checked.__name__ or result.outcome == "fail":
            yield result


def _show(text: str) -> None:
    print(text, end="", file=sys.stderr, flush=True)


@contextlib.contextmanager
def _time_limit(limit: float, label: str) -> Iterator[None]:
    """Raise :class:`OutOfTime` in the block after ``limit`` seconds; end the process if compiled code does not return."""

    def end() -> None:
        sys.stdout.flush()
        print(f"{label}: compiled code did not return within {limit + GRACE_S:g} s: the run ends here", flush=True)
        os._exit(1)

    last = threading.Timer(limit + GRACE_S, end)
    last.daemon = True
    last.start()
    try:
        with Clock(limit).interrupt_when_over():
            yield
    finally:
        last.cancel()


def parametrize(plugins: Iterable[type[Plugin]], expected_failures: Mapping[str, str] | None = None) -> Any:
    """Return a ``pytest.mark.parametrize`` over (plugin, check) pairs: one per check of each variant of the plugins.

    ``expected_failures`` maps the name of a check, or the id of one test (``variant-check``), to the reason of the
    failure. If such a check passes, the test fails. A plugin whose required modules are not installed is one skipped test::

        @bench.conformance.parametrize([MyEstimator], expected_failures={
            "bias_is_as_declared": "biased below 4 samples, see #12"})
        def test_conforms(plugin, check):
            check(plugin)
    """
    import pytest

    reasons = dict(expected_failures or {})
    items, names = [], set()
    for plugin_class in plugins:
        modules = (requirement.partition("=")[0] for requirement in plugin_class.requires)
        missing = [f"not installed: {module}" for module in modules if not registry.installed(module)]
        missing += filter(None, [missing_environment(plugin_class)])
        for name, subject, function in _items(plugin_class):
            title = f"{name}-{function.__name__}"
            names |= {title, function.__name__}
            if missing:
                continue
            reason = reasons.get(title, reasons.get(function.__name__))
            marks = [] if reason is None else [pytest.mark.xfail(reason=reason, strict=True)]
            items.append(pytest.param(subject, partial(_run, function, name), id=title, marks=marks))
        if missing:
            skipped = pytest.mark.skip(reason="; ".join(missing))
            items.append(pytest.param(plugin_class, None, id=plugin_class.name, marks=[skipped]))
    for name in reasons:
        if name not in names:
            raise unknown("check in expected_failures:", name, names)
    return pytest.mark.parametrize(("plugin", "check"), items)


def variants(plugin_class: type[Plugin]) -> dict[str, Plugin]:
    """Return instances by identity: the default, and one per other choice of a string or boolean, except ``dtype``."""
    instances = {plugin_class.name: build(plugin_class, {})}
    for name, parameter in parameters(plugin_class).items():
        choices = (True, False) if parameter.type is bool else parameter.choices or ()
        for choice in choices:
            if choice != parameter.default and name != "dtype":
                values = {name: choice}
                instances[identity(plugin_class.name, values)] = build(plugin_class, values)
    return instances


def missing_environment(plugin_class: type[Plugin]) -> str | None:
    """Return why the environment of a plugin that is an engine cannot be used, or None."""
    if not issubclass(plugin_class, EngineBackend):
        return None
    return build(plugin_class, {}).unavailable_reason()


def _items(plugin_class: type[Plugin]) -> Iterator[tuple[str, Any, Check]]:
    """Yield identity, subject and check for every check of a plugin class.

    The last check verifies that at least one of the others applied.
    """
    for function in _CHECKS[Plugin]:
        yield plugin_class.name, plugin_class, function
    try:
        instances = variants(plugin_class)
    except (Exception, SystemExit):
        yield plugin_class.name, plugin_class, builds
        return
    for name, plugin in instances.items():
        for function in _own_checks(plugin):
            yield name, plugin, function
    if plugin_class.kind in {kind.kind for kind in _CHECKS}:
        yield plugin_class.name, plugin_class, something_was_checked


def _own_checks(plugin: Plugin) -> list[Check]:
    """Return the checks of a plugin's kind and roles."""
    kinds = [kind for kind in _CHECKS if kind is not Plugin and isinstance(plugin, kind)]
    return [function for kind in kinds for function in _CHECKS[kind]]


def builds(plugin_class: type[Plugin]) -> str:
    """Verify that an instance can be created with default parameters, and with each other choice it offers."""
    return f"{len(variants(plugin_class))} variants"


def something_was_checked(plugin_class: type[Plugin]) -> str:
    """Verify that at least one check of the plugin's kind applies to it."""
    for name, plugin in variants(plugin_class).items():
        for function in _own_checks(plugin):
            if (function, plugin_class, name) not in _skipped:
                _outcome(function, plugin, name)
            if not _skipped[function, plugin_class, name]:
                return f"{function.__name__} among others"
    raise Failed("every check of its kind was skipped")


_skipped: dict[tuple[Check, type, str], bool] = {}
"""Whether a check was skipped, by check, plugin class and variant, for the checks that ran in this process."""


def _outcome(function: Check, subject: Any, name: str) -> CheckResult:
    try:
        outcome, detail = "pass", _remembered(function, subject, name)
    except Skipped as reason:
        outcome, detail = "skip", str(reason)
    except Failed as reason:
        outcome, detail = "fail", str(reason)
    except (Exception, SystemExit) as error:
        outcome, detail = "fail", failure(error)["reason"]
    return CheckResult(name, function.__name__, outcome, printable(detail))


def _remembered(function: Check, subject: Any, name: str) -> str:
    """Run the check, record whether it was skipped, and return its details."""
    skipped = False
    try:
        return function(subject)
    except Skipped:
        skipped = True
        raise
    finally:
        _skipped[function, type(subject), name] = skipped


def _run(function: Check, name: str, subject: Any) -> None:
    """Run the check as a test; :class:`Skipped` skips the test."""
    import pytest

    try:
        _remembered(function, subject, name)
    except Skipped as reason:
        pytest.skip(str(reason))
