"""A pytest plugin with an item per case and derivative: ``python -m pytest -p conformance.plugin my_engine.py``.

The item ``judged`` fails if fewer than ``Engine.judged`` derivatives, by default 1, are right or wrong. A file ``xfails.txt`` beside the engine's file has expected failures, a line each, as ``CASE-TERM  # reason`` or ``CASE  # reason``.
Such an item that is right fails, so that the line is removed.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from .runner import TERMS, cases, check, too_few


class EngineFile(pytest.Module):
    """A file with a class ``Engine``."""

    def collect(self) -> Iterator[pytest.Item]:
        """Yield an item per case and term."""
        engine = self.obj.Engine()
        rows = functools.cache(lambda name: check(engine, *cases(name)))
        items = {f"{case.name}-{term}": (case.name, term) for case in cases() for term in ("value", *TERMS)}
        file = self.path.with_name("xfails.txt")
        lines = [line.partition("#") for line in file.read_text().splitlines()] if file.exists() else []
        reasons = {name.strip(): reason.strip() for name, _, reason in lines if name.strip()}
        if strange := set(reasons) - set(items) - {case for case, _ in items.values()}:
            raise self.CollectError(f"{file} names {', '.join(sorted(strange))}, which is not a case or CASE-TERM")
        for name, (case, term) in items.items():
            judged = functools.partial(_judge, rows, case, term)
            item = pytest.Function.from_parent(self, name=name, callobj=judged)
            if (reason := reasons.get(name, reasons.get(case))) is not None:
                item.add_marker(pytest.mark.xfail(reason=reason, strict=True, raises=AssertionError))
            yield item
        yield pytest.Function.from_parent(self, name="judged", callobj=functools.partial(_count, rows, engine))


def _count(rows: Any, engine: Any) -> None:
    """Fail if too few derivatives are right or wrong."""
    text = too_few([row for case in cases() for row in rows(case.name)], getattr(engine, "judged", 1))
    assert not text, text


def _judge(rows: Any, name: str, term: str) -> None:
    """Fail with the reason of a wrong row, and skip what is not given or cannot be judged."""
    row = next((row for row in rows(name) if row["term"] in (term, "all")), None)
    if row is None or row["is_right"] is None:
        pytest.skip((row["reason"] or "its uncertainty is too large") if row else "the engine does not give it")
    assert row["is_right"], row["reason"]


def pytest_collect_file(file_path: Path, parent: Any) -> EngineFile | None:
    """Collect files that define a class ``Engine`` and are named in the command."""
    is_named = file_path.suffix == ".py" and parent.session.isinitpath(file_path)
    has_engine = is_named and re.search(r"^class Engine\b", file_path.read_text(), re.MULTILINE)
    return EngineFile.from_parent(parent, path=file_path) if has_engine else None
