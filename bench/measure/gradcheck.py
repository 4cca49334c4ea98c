"""Diagnoses what is wrong with a gradient from differences of the cost over many step sizes: pure functions of arrays.

A central difference of step h errs by h^2 f'''/6 from the bend of the cost and by about u |f| / h from rounding, so
that its error always rises at both ends (Nocedal and Wright 2006, section 8.1). The verdict therefore compares the
gradient with the differences at the steps between, where neighbours agree best, and compares the errors at both ends
with those of a smooth cost in float64.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

EPS = np.logspace(-2, -10, 17)
"""Step sizes, two per decade, in units of the natural scale."""
GUARD = 64.0
"""Rounding errors granted to a rollout in its cost, and in moving theta."""
RISE = 0.01
"""Relative error from which an end of the curve counts as risen."""
WINDOW = 7
"""Neighbouring steps (three decades of them) along which a jump or a kink has to stay the same."""
BRIEFLY = 4
"""Neighbouring steps along which a one-sided slope has to stay the same in an exploding rollout."""
ALIKE = 0.1
"""Relative spread within which values count as the same."""
FAULTS = ("nondeterministic", "wrong_adjoint", "disconnected")
"""Verdicts on which a gradient must not be used."""
VERDICTS = (
    *FAULTS, "nonfinite", "unsettled", "jump", "kink", "rounding", "mode_crossing", "nonlinear", "zero", "smooth",
)  # fmt: skip
"""All verdicts, worst first."""


@dataclass(frozen=True)
class Sample:
    """A cost along one direction at one point, and the derivative that the program gives there.

    ``step (K,)`` are displacements, falling; ``minus`` and ``plus (K,)`` the costs there, ``centre`` that of the point
    itself. ``crossing (K,)`` marks where the contact mode differs between the two sides. ``scale`` is the size of
    theta, ``slope`` the norm of the program's gradient and ``unit`` the unit roundoff of its arithmetic.
    """

    step: np.ndarray
    minus: np.ndarray
    centre: float
    plus: np.ndarray
    derivative: float
    crossing: np.ndarray
    repeatable: bool = True
    scale: float = 1.0
    slope: float = 0.0
    unit: float = float(np.finfo(np.float64).eps)

    @property
    def differences(self) -> np.ndarray:
        """Central differences, ``(K,)``."""
        return np.asarray((self.plus - self.minus) / (2.0 * self.step))

    @property
    def errors(self) -> np.ndarray:
        """|a - b| / max(1, |a|, |b|) of derivative and differences, ``(K,)``."""
        a, b = self.derivative, self.differences
        return np.asarray(np.abs(a - b) / np.maximum(np.maximum(1.0, abs(a)), np.abs(b)))

    @property
    def finite(self) -> bool:
        """Whether every cost is a number."""
        return bool(np.isfinite(self.minus).all() and np.isfinite(self.plus).all() and np.isfinite(self.centre))

    def rounding(self, unit: float) -> np.ndarray:
        """Return the error of the differences that rounding at that unit roundoff explains, ``(K,)``."""
        costs = max(np.abs(self.minus).max(), np.abs(self.plus).max(), abs(self.centre))
        return np.asarray(GUARD * unit * (costs + self.slope * self.scale) / self.step)

    def size(self, index: int) -> float:
        """Return the larger of derivative and difference at one step, the unit of relative errors."""
        return max(abs(self.derivative), abs(float(self.differences[index])))


def best(sample: Sample) -> int:
    """Return the index of the step with the smallest error; 0 when no error is a number."""
    # argmin takes a NaN for the smallest number
    return int(np.argmin(np.nan_to_num(sample.errors, nan=np.inf)))


def diagnose(sample: Sample) -> str:
    """Return the cause of the differences' errors, one of :data:`VERDICTS`.

    - ``nondeterministic``: the same call gives another cost. ``nonfinite``: a cost is NaN or infinite.
    - ``zero``: derivative and differences are exactly 0. ``disconnected``: only the derivative is 0.
    - ``jump``, ``kink``: plus and minus side differ by a constant in the cost, or in their one-sided slopes, over three
      decades of steps. A kink's derivative must lie between the two slopes. Where the slopes are the same over
      fewer steps, as in an exploding rollout, and the sides meet different contacts, it must be one of the two.
    - ``unsettled``: the differences agree at no step, so that they prove nothing.
    - ``wrong_adjoint``: they settle on a value other than the derivative.
    - the derivative is right, and its differences err at small steps by more than ten times what float64 explains
      (``rounding``), at large ones with a change of contact mode (``mode_crossing``) or without (``nonlinear``),
      or at neither (``smooth``).
    """
    if not sample.repeatable:
        return "nondeterministic"
    if not sample.finite:
        return "nonfinite"
    if not np.isfinite(sample.derivative):
        return "wrong_adjoint"
    with np.errstate(over="ignore", invalid="ignore"):
        return _diagnose(sample)


def _diagnose(sample: Sample) -> str:
    if sample.derivative == 0.0 and not (sample.plus - sample.minus).any():
        return "zero"
    rounding = sample.rounding(sample.unit)
    if _settled(sample.plus - sample.minus, rounding * sample.step):
        return "jump"
    if _settled(_right(sample) - _left(sample), rounding):
        return "kink" if _between(sample, rounding) else _wrong(sample)
    index, spread = plateau(sample, rounding)
    if spread > max(ALIKE * sample.size(index), rounding[index]):
        return _sided(sample, rounding) if sample.crossing[index] else "unsettled"
    # ten times the spread, since the best of many spreads is a lucky one
    tolerance = 10.0 * spread + rounding[index] + _resolution(sample, index)
    right = abs(sample.differences[index] - sample.derivative) <= tolerance
    if right:
        return _ends(sample, index)
    return _sided(sample, rounding) if sample.crossing[index] else _wrong(sample)


def _sided(sample: Sample, rounding: np.ndarray) -> str:
    """Return the verdict by one-sided slopes, where the two sides of every difference meet different contacts.

    A slope settles where it is the same over BRIEFLY neighbouring steps. In an exploding rollout that happens
    only at the smallest steps, where rounding is amplified like the state, and over fewer steps than a kink needs.
    """
    settled = False
    for slopes in (_left(sample), _right(sample)):
        for window, noise in zip(_windows(slopes, BRIEFLY), _windows(rounding, BRIEFLY)[:, -1], strict=True):
            middle, spread = float(np.median(window)), float(np.ptp(window))
            if spread + noise > ALIKE * abs(middle):
                continue
            settled = True
            tolerance = 2.0 * spread + noise + float(np.cbrt(sample.unit)) * abs(middle)
            if abs(middle - sample.derivative) <= tolerance:
                return "kink"
    return _wrong(sample) if settled else "unsettled"


def plateau(sample: Sample, rounding: np.ndarray) -> tuple[int, float]:
    """Return the index of the step whose difference agrees best with its neighbours, and by how much they disagree.

    Rounding counts as disagreement, because differences rounded to 0 agree without meaning anything. Steps
    across which the contact mode changes are left out when three others remain.
    """
    differences = sample.differences
    apart = np.abs(np.diff(differences))
    spread = np.fmax(np.r_[apart[0], apart], np.r_[apart, apart[-1]])
    worth = spread + rounding
    if (~sample.crossing).sum() >= 3:
        worth = np.where(sample.crossing, np.inf, worth)
    if sample.derivative != 0.0 and differences.any():
        worth = np.where(differences == 0.0, np.inf, worth)
    index = int(np.argmin(worth))
    return index, float(spread[index])


def _resolution(sample: Sample, index: int) -> float:
    """Return u^(1/3) of the derivative's size, the relative step that balances a central difference's two errors."""
    return float(np.cbrt(sample.unit)) * sample.size(index)


def _wrong(sample: Sample) -> str:
    return "disconnected" if sample.derivative == 0.0 else "wrong_adjoint"


def _right(sample: Sample) -> np.ndarray:
    return np.asarray((sample.plus - sample.centre) / sample.step)


def _left(sample: Sample) -> np.ndarray:
    return np.asarray((sample.centre - sample.minus) / sample.step)


def _between(sample: Sample, rounding: np.ndarray) -> bool:
    """Return whether the derivative lies between the one-sided slopes over the smallest step that rounding resolves.

    A slope is trusted to within its change since the step before, which exceeds its error of order h.
    """
    resolved = [i for i in range(1, rounding.size) if rounding[i] <= _resolution(sample, i)]
    finest = resolved[-1] if resolved else int(np.argmin(rounding[1:])) + 1
    slopes = [(side[finest], abs(side[finest] - side[finest - 1])) for side in (_left(sample), _right(sample))]
    tolerance = rounding[finest] + _resolution(sample, finest)
    low = min(slope - change for slope, change in slopes) - tolerance
    high = max(slope + change for slope, change in slopes) + tolerance
    return bool(low <= sample.derivative <= high)


def _settled(values: np.ndarray, noise: np.ndarray) -> bool:
    """Return whether some window of values is constant to within ``ALIKE`` of its middle and exceeds the noise."""
    windows = _windows(values, WINDOW)
    middle = np.abs(np.median(windows, axis=1))
    noises = _windows(noise, WINDOW).max(axis=1)
    same = np.ptp(windows, axis=1) <= ALIKE * middle
    return bool((same & (middle > noises)).any())


def _windows(values: np.ndarray, size: int) -> np.ndarray:
    """Return each run of ``size`` neighbouring values, ``(K - size + 1, size)``."""
    return np.lib.stride_tricks.sliding_window_view(values, size)


def _ends(sample: Sample, index: int) -> str:
    """Return the verdict on a derivative that is right, by how its differences err at small and at large steps."""
    errors = np.abs(sample.differences - sample.derivative)
    small = np.arange(errors.size) > index
    if (errors > 10.0 * sample.rounding(float(np.finfo(np.float64).eps)))[small].sum() >= 3:
        return "rounding"
    risen = (errors > RISE * sample.size(index)) & ~small & (errors > sample.rounding(sample.unit))
    if (risen & sample.crossing).any():
        return "mode_crossing"
    return "nonlinear" if risen.any() else "smooth"
