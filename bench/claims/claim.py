"""The contract of a claim: a statement, its source, and the figures that decide it."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from bench.model import Plugin

STANDARD_ERRORS = 3.5
"""Standard errors by which a measured figure may differ from a published one. All claims together have about a hundred
figures, so about one run of all claims in twenty fails by chance, and more would with a smaller number."""

SENSITIVITY = 0.05
"""Relative error of a published number that a figure should detect; otherwise :attr:`Figure.limitation` is the reason."""

REPRODUCED = "reproduced"
RESERVED = "reproduced with a reservation"
NOT_REPRODUCED = "not reproduced"
UNDECIDED = "not decidable here"
VERDICTS = (REPRODUCED, RESERVED, NOT_REPRODUCED, UNDECIDED)


@dataclass(frozen=True)
class Figure:
    """A published number and the measured number.

    The two agree if they differ by at most the sum of half the last published digit, the source's own ``spread`` and 3.5
    standard errors of the measurement. With ``factor``, they agree if each is at most ``factor`` times the other.
    """

    what: str
    """The quantity in a few words."""
    published: str
    """The number as the claim's ``origin`` gives it: its last digit shows its precision."""
    measured: float
    error: float = 0.0
    """Standard error of the measured number."""
    spread: float = 0.0
    """Half the range that the source states or allows."""
    factor: float = 0.0
    """Largest ratio at which numbers from heavy-tailed samples agree; 0 to compare by the difference instead."""

    @property
    def value(self) -> float:
        """The published number."""
        return float(self.published)

    @property
    def tolerance(self) -> float:
        """Largest difference at which the two numbers agree. With ``factor``, the largest difference upwards."""
        if self.factor:
            return (self.factor - 1.0) * abs(self.value)
        return last_digit(self.published) / 2 * (1 + 1e-9) + self.spread + STANDARD_ERRORS * self.error

    @property
    def agrees(self) -> bool:
        """Whether the published and the measured number agree."""
        if not math.isfinite(self.measured):
            return False
        if self.factor:
            ratio = self.measured / self.value if self.value else math.inf
            return 1.0 / self.factor <= ratio <= self.factor
        return abs(self.measured - self.value) <= self.tolerance

    @property
    def detectable_error(self) -> float:
        """Smallest relative error of the published number with which the two numbers would no longer agree."""
        if self.value == 0.0:
            return 0.0 if self.tolerance < 1.0 else math.inf
        if self.factor:
            return self.factor * max(self.measured / self.value, self.value / self.measured) - 1.0
        return (self.tolerance + abs(self.measured - self.value)) / abs(self.value)

    @property
    def is_sensitive(self) -> bool:
        """Whether a published number that is 5% too large or too small would have failed."""
        return self.detectable_error < SENSITIVITY / (1 + SENSITIVITY)

    @property
    def limitation(self) -> str:
        """The main reason why an error of 5% is not detected; empty if it is detected."""
        if self.is_sensitive:
            return ""
        if self.factor:
            return f"heavy tails, compared by a factor of {self.factor:g}"
        parts = {
            "the printed digits": last_digit(self.published) / 2,
            "the source's own spread": self.spread,
            "the measurement's error": STANDARD_ERRORS * self.error,
        }
        return max(parts, key=lambda name: parts[name])

    @property
    def can_fail(self) -> bool:
        """Whether the figure would fail for a published number of the other sign or 0."""
        return self.detectable_error < 1.0 or bool(self.factor)


def last_digit(text: str) -> float:
    """Return the value of one unit in the last digit of a printed number.

    >>> last_digit("34.085"), last_digit("1.05e6"), last_digit("7")
    (0.001, 10000.0, 1.0)
    """
    mantissa, _, power = text.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return float(f"1e{int(power or 0) - decimals}")


@dataclass(frozen=True)
class Outcome:
    """The measurements of a claim."""

    figures: Sequence[Figure]
    reservation: str = ""
    """A condition or doubt that readers must know although the figures agree."""
    series: Mapping[str, Any] = field(default_factory=dict)
    """The chart: places along x by the axis's label, then each curve by its label, as values or as means with their standard errors."""


def verdict(figures: Sequence[Figure], reservation: str = "") -> str:
    """Return one of :data:`VERDICTS`. The verdict has a reservation, too, if no figure detects an error of 5%."""
    if any(not figure.agrees for figure in figures):
        return NOT_REPRODUCED
    if not any(figure.can_fail for figure in figures):
        return UNDECIDED
    return RESERVED if reservation or not any(figure.is_sensitive for figure in figures) else REPRODUCED


class Claim(Plugin):
    """A published result, verified by a few figures. ``name`` is short, such as ``C1``.

    Claims are plugins of the kind ``claims``: the files of ``plugins/claims``, files in a folder ``plugins=DIR``,
    and classes or modules that an entry point of the group ``bench.claims`` names.
    """

    kind: ClassVar[str] = "claims"
    lesson: ClassVar[str]
    """The lesson that the claim belongs to, see :data:`bench.claims.discovery.LESSONS`."""
    statement: ClassVar[str]
    """The source's statement, in a sentence."""
    source: ClassVar[str]
    """Authors, year, venue."""
    origin: ClassVar[Literal["printed", "data file", "recomputed"]] = "printed"
    """Where the figures are from: printed in the source, from its data file, or recomputed here in another way."""
    learned: ClassVar[str]
    """The conclusion for a reader, in a sentence."""
    quick: ClassVar[bool] = True
    """Whether measuring takes less than 5 s on two cores."""
    quantity: ClassVar[str] = ""
    """What the chart's curves show, the label of its y axis."""
    logarithmic: ClassVar[str] = ""
    """The axes that are logarithmic: ``x``, ``y`` or ``xy``."""
    marks: ClassVar[Sequence[tuple[Literal["x", "y"], float, str]]] = ()
    """Values that are drawn as lines: axis, value and label."""

    @abstractmethod
    def measure(self) -> Outcome:
        """Measure the figures. Raises :class:`bench.Unsupported` if a library is missing."""
