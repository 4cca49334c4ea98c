"""Compares two sets of results cell by cell: did something get worse?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.compare.report import Comparison

__all__ = ["compare"]


def compare(before: str | Path, after: str | Path, again: Sequence[str | Path] = ()) -> Comparison:
    """Compare two results, cell by cell; ``print`` shows what got worse or better.

    ``before`` and ``after`` are directories of experiments or of one experiment, or git revisions as ``REV`` or
    ``REV:PATH``. ``comparison.to_frame()`` has one row per cell, and ``comparison.worse`` is true if some cell got
    worse. With ``again``, two or more further runs of ``before``, times are compared with the spread between runs. Raises
    :class:`bench.UserError` for results that cannot be read or compared.
    """
    from bench.compare.command import compare_results

    return compare_results(str(before), str(after), [*map(str, again)])
