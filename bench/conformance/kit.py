"""Registers checks, and runs them on plugins as pytest tests."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from bench.engines.backend import EngineBackend
from bench.errors import UserError, printable, unknown
from bench.host.identity import identity
from bench.host.parameters import build, parameters
from bench.model import Estimator, Plugin, registry
from bench.simulator.clock import parse_duration


class Failed(Exception):
    """Raised when a plugin's behaviour differs from its declaration."""


class Skipped(Exception):
    """Raised when a check does not apply to the plugin."""


Check = Callable[[Any], str]
CHOSEN = "BENCH_CHECK"
"""Environment variable with the names of the plugins to check and the folders of plugins, as JSON."""
HERE = Path(__file__).parent
PYTEST = (
    *(str(HERE / "checks.py"), "-c", os.devnull, f"--rootdir={HERE}", "--noconftest", "-p", "no:cacheprovider"),
    *("-p", "xdist.plugin", "-n1", "--max-worker-restart=1000", "--assert=plain", "--tb=short", "-q"),
    *("-o", "faulthandler_exit_on_timeout=true"),
)
"""Arguments of pytest: none of the current folder's settings, no cache, and a worker that is replaced where it ends."""
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


def skip_unless(condition: Any, reason: str) -> None:
    """Raise :class:`Skipped` unless the condition holds."""
    if not condition:
        raise Skipped(reason)


def main(names: Sequence[str], limit: str = "15m", options: Sequence[str] = ()) -> int:
    """Check the named plugins, or all, in pytest, print a line per check, and return the exit status.

    A check that takes longer than ``limit`` fails, and so does one that ends its process. ``options`` are
    pytest's.
    """
    seconds, plugins = parse_duration(limit, "limit"), {name for table in registry.entries().values() for name in table}
    for name in set(names) - plugins:
        raise registry.unknown_plugin("plugin", name, plugins, "list")
    if not (registry.installed("pytest") and registry.installed("xdist")):
        raise UserError("check needs pytest and pytest-xdist: pip install 'diffsim-bench[check]'")
    from unittest.mock import patch

    import pytest

    chosen = json.dumps([[*names], [str(folder) for folder in registry.folders()]])
    with patch.dict(os.environ, {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", CHOSEN: chosen}):
        for foreign in ("PYTEST_ADDOPTS", "PYTEST_PLUGINS"):
            os.environ.pop(foreign, None)
        words = [*PYTEST, "-o", f"faulthandler_timeout={seconds}", *options]
        status = pytest.main(words, plugins=[sys.modules[__name__]])
    if status == pytest.ExitCode.INTERRUPTED:
        raise KeyboardInterrupt
    return int(status) if status in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED) else 2


def pytest_report_teststatus(report: Any) -> tuple[str, str, str] | None:
    """Print an outcome as a line, with the number of a passed check or a reason; pytest calls this hook.

    A failure of which the line has the whole reason has a category of its own, of which pytest repeats nothing below.
    """
    if report.passed and report.when != "call":
        return None
    category = report.outcome
    if report.passed:
        detail = dict(report.user_properties)["found"]
    elif report.skipped:
        detail = report.longrepr[2].removeprefix("Skipped: ")
    else:
        *above, detail = str(report.longrepr).splitlines()
        category = "failed" if above else "not as declared"
    plugin, _, name = report.nodeid.partition("[")[2][:-1].rpartition("-")
    return category, f"{report.outcome[:4]}  {plugin:<38} {name:<38} {detail}\n", report.outcome.upper()


def parametrize(plugins: Iterable[type[Plugin]], expected_failures: Mapping[str, str] | None = None) -> Any:
    """Return a ``pytest.mark.parametrize`` over (plugin, check) pairs: one per check of each variant of the plugins.

    ``expected_failures`` maps the name of a check, or the id of one test (``variant-check``), to the reason of the
    failure. If such a check passes, the test fails. Tests of a plugin whose required modules are not installed are skipped::

        @bench.conformance.parametrize([MyEstimator], expected_failures={
            "bias_is_as_declared": "biased below 4 samples, see #12"})
        def test_conforms(plugin, check):
            check(plugin)
    """
    import pytest

    reasons, items = expected_failures or {}, []
    names: set[str] = set()
    for plugin_class in plugins:
        missing = registry.missing_modules(plugin_class) or missing_environment(plugin_class)
        for name, subject, function in _items(plugin_class):
            titles = f"{name}-{function.__name__}", function.__name__
            names.update(titles)
            marks = [pytest.mark.xfail(reason=reasons[title], strict=True) for title in titles if title in reasons][:1]
            if missing:
                marks = [pytest.mark.skip(reason=missing)]
            items.append(pytest.param(subject, partial(run, function), id=titles[0], marks=marks))
    for name in reasons:
        if name not in names:
            raise unknown("check in expected_failures:", name, names)
    return pytest.mark.parametrize(("plugin", "check"), items)


def run(function: Check, subject: Any) -> str:
    """Run the check as a test, and return its number; :class:`Skipped` skips the test, :class:`Failed` fails it."""
    import pytest

    try:
        found = printable(function(subject))
    except Skipped as reason:
        pytest.skip(printable(reason))
    except Failed as reason:
        raise pytest.fail.Exception(printable(reason), pytrace=False) from None
    _PASSED.add(type(subject))
    return found


_PASSED: set[type] = set()
"""Classes of the plugins that passed a check of their kind in this process."""


def variants(plugin_class: type[Plugin]) -> dict[str, Plugin]:
    """Return instances by identity: the default, and one per other choice of a string or boolean.

    Except ``dtype`` and the design of an estimator's noise, which have checks of their own.
    """
    instances = {plugin_class.name: build(plugin_class, {})}
    for name, parameter in parameters(plugin_class).items():
        choices = (True, False) if parameter.type is bool else parameter.choices or ()
        for choice in choices:
            if choice != parameter.default and name not in ("dtype", *parameters(Estimator)):
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
    except (Exception, SystemExit):  # the check ``builds`` fails
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


def something_was_checked(plugin_class: type[Plugin]) -> str:
    """Verify that at least one check of the plugin's kind applies to it."""
    if plugin_class in _PASSED:
        return "at least one passed"
    for plugin in variants(plugin_class).values():
        for function in _own_checks(plugin):
            with contextlib.suppress(Skipped):
                return function(plugin)
    raise Failed("every check of its kind was skipped")
