"""Formats numbers as strings, the same in tables, charts, pages and on the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable

from bench.errors import printable as one_line

__all__ = ["apart", "axis_value", "counted", "duration", "interval", "listed", "number", "one_line"]


def number(value: float, digits: int = 2) -> str:
    """Return a number as a short string with ``digits`` significant digits; ``-`` for a missing number.

    >>> number(0.0213), number(350.0), number(123456.0), number(math.nan)
    ('0.021', '350', '1.2e5', '-')
    """
    if not math.isfinite(value):
        return "-" if math.isnan(value) else str(float(value))
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)
    if -4 < power < max(digits, 4):
        return f"{float(f'{mantissa}e{power}'):.{max(digits - 1 - power, 0)}f}"
    return f"{mantissa}e{power}"


def rounded(value: float) -> float:
    """Return a number as :func:`number` prints it, so that a colour never contradicts its text: 0.999 is 1.0."""
    return float(number(value)) if math.isfinite(value) else value


def apart(value: float, boundary: float, digits: int = 2) -> str:
    """Return a number with at least ``digits`` significant digits, and so many that it does not print as a boundary that it differs from.

    >>> apart(1.0312, 1.0), apart(1.0, 1.0), apart(0.9996, 1.0), apart(6.94, 1.0)
    ('1.03', '1.0', '0.9996', '6.9')
    """
    if not math.isfinite(value) or value == boundary:
        return number(value, digits)
    return next(text for text in (number(value, places) for places in range(digits, 18)) if float(text) != boundary)


def interval(value: float, low: float, high: float, boundary: float = 1.0) -> str:
    """Return a ratio with its interval, whose ends never print as the boundary that they differ from.

    Ratios above 10,000 and below 1/10,000 are as good as infinite and 0.

    >>> interval(2.83, 1.03, 6.9), interval(2.0, 0.0, math.inf)
    ('2.8 [1.03, 6.9]', '2.0 [0, no limit]')
    """
    ends = apart(low, boundary) if low > 1e-4 else "0", apart(high, boundary) if high < 1e4 else "no limit"
    return f"{number(value)} [{', '.join(ends)}]"


def axis_value(value: float) -> str:
    """Return a value of an axis as a string; ``-`` if it is not finite.

    >>> axis_value(0.01), axis_value(3000.0), axis_value(1e4)
    ('0.01', '3000', '1e4')
    """
    if not math.isfinite(value):
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:g}"
    mantissa, exponent = f"{value:e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"


def duration(seconds: float) -> str:
    """Return a time in seconds as a string in us, ms or s; ``-`` if it is not finite.

    >>> duration(0.00021), duration(0.0123), duration(1.5)
    ('210 us', '12 ms', '1.5 s')
    """
    if not math.isfinite(seconds):
        return "-"
    for unit, factor in (("us", 1e6), ("ms", 1e3)):
        if seconds * factor < 999.5:
            return f"{number(seconds * factor)} {unit}"
    return f"{number(seconds)} s"


def short_duration(seconds: float) -> str:
    """Return a time as :func:`duration` does, with the sign of micro and without ``.0``."""
    return duration(seconds).replace("us", "µs").replace(".0 ", " ")


def span(low: float, high: float, digits: int = 2, suffix: str = "") -> str:
    """Return two ends as short strings, or one number where both print the same.

    >>> span(0.1, 0.15), span(1501.0, 1502.0)
    ('0.10 to 0.15', '1500')
    """
    ends = number(low, digits) + suffix, number(high, digits) + suffix
    return ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"


def counted(count: int, one: str) -> str:
    """Return a count with its noun in the singular or plural.

    >>> counted(1, "cell"), counted(3, "cell")
    ('1 cell', '3 cells')
    """
    return f"{count} {one}{'s' * (count != 1)}"


def listed(names: Iterable[str]) -> str:
    """Return names as an enumeration.

    >>> listed(["a"]), listed(["a", "b", "c"])
    ('a', 'a, b and c')
    """
    *rest, last = names
    return f"{', '.join(rest)} and {last}" if rest else last
