"""The report of an examination: its findings, as a page and as an assertion too."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bench.examine.findings import Findings


@dataclass(frozen=True)
class Report(Findings):
    """The findings about a cost and its gradient at a theta; ``print`` shows them as text.

    ``frame``, ``sigmas`` and ``breaks`` are tables of them, ``problems`` and ``warnings`` sentences, ``status`` the exit
    status.
    """

    def assert_right(self) -> None:
        """Raise AssertionError with the whole text where something cannot be trusted."""
        if self.problems:
            raise AssertionError(f"{'; '.join(self.problems)}\n\n{self}")

    def save(self, directory: str | Path) -> list[Path]:
        """Write the text, the tables, the charts and ``report.html`` into a directory; returns their paths."""
        # charts and tables take a second to import, which a report without files need not
        from bench.examine import page

        return page.write(self, Path(directory).expanduser())
