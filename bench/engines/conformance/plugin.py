"""A pytest plugin with an item per case and derivative: ``python -m pytest -p conformance.plugin my_engine.py``.

A file ``xfails.txt`` beside the engine's file has expected failures, a line each, as ``CASE-TERM  # reason`` or ``CASE  # reason``.
Such an item that is right fails, so that the line is removed.
"""

from __future__ import annotations

import functools
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from .runner import TERMS, Case, cases, check


class EngineFile(pytest.File):
    """A file with a class ``Engine``."""

    def collect(self) -> Iterator[pytest.Item]:
        """Yield an item per case and term."""
        sys.path.append(str(self.path.parent))
        self.rows = functools.cache(functools.partial(self._rows, runpy.run_path(str(self.path))["Engine"]()))
        file = self.path.with_name("xfails.txt")
        lines = [line.partition("#") for line in file.read_text().splitlines()] if file.exists() else []
        reasons = {name.strip(): reason.strip() for name, _, reason in lines if name.strip()}
        names = {f"{case.name}-{term}": (case, term) for case in cases() for term in ("value", *TERMS)}
        if strange := set(reasons) - set(names) - {case.name for case, _ in names.values()}:
            raise self.CollectError(f"{file} names {', '.join(sorted(strange))}, which is no case or CASE-TERM")
        for name, (case, term) in names.items():
            item = Derivative.from_parent(self, name=name, case=case, term=term)
            if (reason := reasons.get(name, reasons.get(case.name))) is not None:
                item.add_marker(pytest.mark.xfail(reason=reason, strict=True, raises=AssertionError))
            yield item

    @staticmethod
    def _rows(engine: Any, name: str) -> list[dict[str, Any]]:
        return check(engine, *cases(name))


class Derivative(pytest.Item):
    """A value or derivative of a case."""

    def __init__(self, *, case: Case, term: str, **settings: Any) -> None:
        super().__init__(**settings)
        self.case, self.term = case, term

    def runtest(self) -> None:
        """Fail with the reason of a wrong row, and skip what is not given or cannot be judged."""
        rows = [row for row in self.parent.rows(self.case.name) if row["term"] in (self.term, "all")]  # type: ignore[union-attr]
        if not rows or rows[0]["is_right"] is None:
            pytest.skip(
                (rows[0]["reason"] or "its uncertainty is too large") if rows else "the engine does not give it"
            )
        assert rows[0]["is_right"], rows[0]["reason"]

    def repr_failure(self, excinfo: Any, style: Any = None) -> str:
        """Return the reason."""
        return f"{self.name}: {excinfo.value}"

    def reportinfo(self) -> tuple[Path, None, str]:
        """Return the engine's file and the item's name."""
        return self.path, None, self.name


def pytest_collect_file(file_path: Path, parent: Any) -> EngineFile | None:
    """Collect files that define a class ``Engine`` and are named in the command."""
    is_named = file_path.suffix == ".py" and parent.session.isinitpath(file_path)
    return (
        EngineFile.from_parent(parent, path=file_path)
        if is_named and "\nclass Engine" in file_path.read_text()
        else None
    )
