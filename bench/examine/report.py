"""The report of an examination: findings that can be asserted and saved as a page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bench.examine.findings import Findings


@dataclass(frozen=True)
class Report(Findings):
    """The findings about a cost and its gradient at one theta; ``print`` shows them as text.

    ``frame``, ``sigmas`` and ``breaks`` are tables, ``problems`` and ``warnings`` are sentences, and ``status`` is the
    exit status.
    """

    def assert_right(self) -> None:
        """Raise AssertionError with the full report if there is a problem."""
        if self.problems:
            raise AssertionError(f"{'; '.join(self.problems)}\n\n{self}")

    def save(self, directory: str | Path) -> list[Path]:
        """Write text, tables, charts and ``report.html`` into a directory, and return the paths of the files."""
        # importing charts and tables takes a second, which a report without files does not need
        from bench.examine import page

        return page.write(self, Path(directory).expanduser())
