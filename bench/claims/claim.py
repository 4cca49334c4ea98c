"""The contract of a claim: a statement, its source, and figures that decide it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ERRORS = 3.5
"""Standard errors by which a measured figure may miss a published one: with some hundred figures one in twenty full runs
would otherwise fail by chance."""

SEEN = 0.05
"""The relative error of a published number that a figure should notice; one that cannot says so, and why."""

REPRODUCED = "reproduced"
RESERVED = "reproduced with a reservation"
NOT_REPRODUCED = "not reproduced"
UNDECIDED = "not decidable here"
VERDICTS = (REPRODUCED, RESERVED, NOT_REPRODUCED, UNDECIDED)


@dataclass(frozen=True)
class Figure:
    """One published number beside the measured one.

    They agree where they differ by at most half the last published digit, the source's own ``spread``, and 3.5 standard
    errors of the measurement; or, where ``factor`` is given, where each is at most that many times the other.
    """

    what: str
    published: str
    """As printed in the source, so that its last digit counts."""
    measured: float
    error: float = 0.0
    """Standard error of the measured number."""
    spread: float = 0.0
    """Half the range that the source itself gives or allows."""
    factor: float = 0.0
    """Ratio within which a number of heavy tails is the same; 0: differences decide."""

    @property
    def value(self) -> float:
        """The published number."""
        return float(self.published)

    @property
    def slack(self) -> float:
        """Difference at which the two still agree; half of what a factor allows upwards, where one is given."""
        if self.factor:
            return (self.factor - 1.0) * abs(self.value)
        return last_digit(self.published) / 2 * (1 + 1e-9) + self.spread + ERRORS * self.error

    @property
    def agrees(self) -> bool:
        """Whether published and measured number are the same within the slack."""
        if not math.isfinite(self.measured):
            return False
        if self.factor:
            ratio = self.measured / self.value if self.value else math.inf
            return 1.0 / self.factor <= ratio <= self.factor
        return abs(self.measured - self.value) <= self.slack

    @property
    def resolution(self) -> float:
        """Relative change of the published number from which on the two would no longer agree."""
        if self.value == 0.0:
            return 0.0 if self.slack < 1.0 else math.inf
        if self.factor:
            return self.factor * max(self.measured / self.value, self.value / self.measured) - 1.0
        return (self.slack + abs(self.measured - self.value)) / abs(self.value)

    @property
    def sees(self) -> bool:
        """Whether a published number that is 5% too large or too small would have failed."""
        return self.resolution < SEEN / (1 + SEEN)

    @property
    def limit(self) -> str:
        """What keeps the figure from seeing an error of 5%; empty where it sees one."""
        if self.sees:
            return ""
        if self.factor:
            return f"heavy tails, compared by a factor of {self.factor:g}"
        parts = {
            "the printed digits": last_digit(self.published) / 2,
            "the source's own spread": self.spread,
            "the measurement's error": ERRORS * self.error,
        }
        return max(parts, key=lambda name: parts[name])

    @property
    def decides(self) -> bool:
        """Whether the figure could have failed by its sign, or against 0."""
        return self.resolution < 1.0 or bool(self.factor)


def last_digit(text: str) -> float:
    """Return one unit of the last digit of a printed number.

    >>> last_digit("34.085"), last_digit("1.05e6"), last_digit("7")
    (0.001, 10000.0, 1.0)
    """
    mantissa, _, power = text.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return float(f"1e{int(power or 0) - decimals}")


@dataclass(frozen=True)
class Outcome:
    """What a claim measured."""

    figures: Sequence[Figure]
    reservation: str = ""
    """What has to be said beside the figures, although they agree."""
    series: Mapping[str, Any] = field(default_factory=dict)
    """Numbers and lists of numbers for the chart."""


def verdict(figures: Sequence[Figure], reservation: str = "") -> str:
    """Return one of :data:`VERDICTS`; where no figure sees an error of 5%, that is a reservation too."""
    if any(not figure.agrees for figure in figures):
        return NOT_REPRODUCED
    if not any(figure.decides for figure in figures):
        return UNDECIDED
    return RESERVED if reservation or not any(figure.sees for figure in figures) else REPRODUCED


class Claim(ABC):
    """A published result that a few figures decide.

    Subclasses are found as the files of ``bench/claims/published``, and through the entry-point group ``bench.claims``.
    """

    name: ClassVar[str]
    """Short name on the command line: ``C1``."""
    lesson: ClassVar[str]
    """The lesson that it belongs to."""
    statement: ClassVar[str]
    """What the source says, in a sentence."""
    source: ClassVar[str]
    """Authors, year, venue."""
    learned: ClassVar[str]
    """What one learns from it, in a sentence."""
    quick: ClassVar[bool] = True
    """Whether it takes less than 5 s on two cores."""
    labels: ClassVar[tuple[str, str]] = ("", "")
    """Names of the chart's axes."""

    @abstractmethod
    def measure(self) -> Outcome:
        """Measure the figures. Raises :class:`bench.Unsupported` where a library is missing."""

    @abstractmethod
    def draw(self, axes: Axes, series: Mapping[str, Any]) -> None:
        """Draw the source's point from the stored series."""
