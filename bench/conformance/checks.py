"""The tests that ``python -m bench check`` gives to pytest: every check of the chosen plugins."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from bench.conformance.kit import CHOSEN, Check, Failed, Skipped, missing_environment, parametrize, run
from bench.model import registry

NAMES, FOLDERS = json.loads(os.environ[CHOSEN])


def _items() -> Iterator[Any]:
    """Yield the tests of the chosen plugins; a plugin that cannot be used is a failed test if it was named."""
    for folder in FOLDERS:
        registry.add_folder(Path(folder))
    for entry in (entry for table in registry.entries().values() for entry in table.values()):
        if entry.name in NAMES or not NAMES:
            plugin = entry.plugin
            reason = entry.reason if plugin is None or entry.reason else missing_environment(plugin)
            if plugin is None or reason:
                yield pytest.param(reason, partial(run, available), id=f"{entry.name}-available")
            else:
                yield from parametrize([plugin]).args[1]


def available(reason: str) -> str:
    """Refuse a plugin that cannot be used; it is skipped where all plugins are checked."""
    raise (Failed if NAMES else Skipped)(reason)


@pytest.mark.parametrize(("plugin", "check"), list(_items()))
def test_conforms(plugin: Any, check: Check, record_property: Any) -> None:
    """Run a check, and record the number that it found."""
    record_property("found", check(plugin))
