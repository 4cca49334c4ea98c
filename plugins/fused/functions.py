"""Source of helper functions for kernels: functions that Python lacks, and vectorisable sine and cosine.

Sine and cosine reduce the angle by multiples of pi/2 in three parts (Cody, Waite 1980) and sum Taylor series to the
order at which the next term is below 1e-18. The first two parts have 33 bits, so that their products with a multiple
below 2^20 are exact. A kernel reports larger angles and is then run again with the C library's functions.
"""

from __future__ import annotations

import math

LIMIT = 1.6e6
"""Maximum angle [rad] of the fast sine and cosine."""

P1, P2, P3 = 1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21
"""Three floats that add up to pi / 2, the first two with 33 bits each."""


def _series(first: int, last: int) -> str:
    """Return source for the sum of (-1)^i z^i / n! over n = first, first + 2, ..., last, in Horner's form, z = r^2."""
    text = ""
    for i, order in reversed([*enumerate(range(first, last + 1, 2))]):
        term = f"F({(-1) ** i / math.factorial(order)!r})"
        text = f"({term} + z * {text})" if text else term
    return text


FAST = f"""
LIMIT = {LIMIT!r}


@njit(error_model="numpy")
def turned_(x, shift):
    k = np.rint(x * F({2 / math.pi!r}))
    r = ((x - k * F({P1!r})) - k * F({P2!r})) - k * F({P3!r})
    z = r * r
    sine = r * {_series(1, 19)}
    cosine = {_series(0, 20)}
    # of the quadrant: 0 to 3
    turn = k + shift
    turn = turn - F(4.0) * np.floor(turn * F(0.25))
    odd = (turn == F(1.0)) | (turn == F(3.0))
    result = cosine if odd else sine
    return -result if turn >= F(2.0) else result


@njit(error_model="numpy")
def sin_(x):
    return turned_(x, F(0.0))


@njit(error_model="numpy")
def cos_(x):
    return turned_(x, F(1.0))
"""


SIMPLE = {
    "max_": "(a, b):\n    return a if (a > b) | (a != a) else b",
    "min_": "(a, b):\n    return a if (a < b) | (a != a) else b",
    "sign_": "(x):\n    return F(1.0) if x > F(0.0) else (F(-1.0) if x < F(0.0) else x)",
    "rsqrt_": "(x):\n    return F(1.0) / math.sqrt(x)",
    "logistic_": "(x):\n    return F(1.0) / (F(1.0) + math.exp(-x))",
}
SLOW = """
LIMIT = math.inf


@njit(error_model="numpy")
def sin_(x):
    return math.sin(x)


@njit(error_model="numpy")
def cos_(x):
    return math.cos(x)
"""
"""Source of sine and cosine by the C library, for any angle."""


def helpers(used: set[str]) -> str:
    """Return the source of the helper functions named in ``used``."""
    angles = bool(used & {"sin_", "cos_"})
    names = sorted(SIMPLE.keys() & (used | {"max_"} if angles else used))
    parts = [f'\n@njit(error_model="numpy")\ndef {name}{SIMPLE[name]}\n' for name in names]
    return "\n".join([*parts, FAST] if angles else parts)
