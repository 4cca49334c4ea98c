"""The report of an examination: findings that can be asserted, compared with a baseline, and saved as files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from bench.errors import local_path, needing_sweeps
from bench.examine import UPDATE, baseline, text
from bench.examine.findings import Findings


@dataclass(frozen=True, repr=False)
class Report(Findings):
    """The findings about a cost and its gradient at one theta; ``print`` shows them as text.

    ``derivative`` and ``noise_answer`` are the two answers, ``frame``, ``sigmas`` and ``breaks`` are tables,
    ``problems`` and ``warnings`` are sentences, and ``status`` is the exit status: 0 right, 1 wrong, 3 not decided.
    """

    conclusion = property(text.conclusion)
    noise_answer = property(text.noise_answer)
    problems = property(text.problems)
    warnings = property(text.warnings)
    advice = property(text.advice)
    __str__ = text.write

    def __repr__(self) -> str:
        return str(self)

    def assert_right(self) -> None:
        """Raise AssertionError with the full report unless the status is 0."""
        if self.status:
            raise AssertionError(f"{'; '.join(self.problems)}\n\n{self}")

    def compared(self, file: str | Path, update: bool = False) -> Self:
        """Return the report compared with a baseline file: with status 0 where it is not worse than the baseline.

        A missing baseline is written if the status is 0. With ``update`` the baseline is written, and nothing is compared.
        """
        path = local_path("baseline", file)
        before = None if update else baseline.read_baseline(path)
        if before is None:
            if is_written := update or self.status == 0:
                baseline.write_baseline(path, self)
            done = "written" if is_written else f"not written since the status is {self.status}; {UPDATE} writes it"
            return replace(self, changes=[f"{path}: {'' if update else 'no such file, '}{done}"], is_as_before=update)
        changes, is_worse = baseline.differences(before, self)
        return replace(self, changes=changes or ["no change"], is_as_before=not is_worse)

    def save(self, directory: str | Path) -> list[Path]:
        """Write text, tables and charts into a directory, and return the paths of the files."""
        # importing charts and tables takes a second, which a report without files does not need
        with needing_sweeps("save"):
            from bench.examine import files

        return files.write(self, local_path("save", directory))
