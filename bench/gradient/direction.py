"""Checks the derivative along one direction against differences of the cost over many step sizes.

A central difference of step h has an error of h^2 f'''/6 from the curvature of the cost and about u |f| / h from
rounding, so its error rises at small and at large steps (Nocedal and Wright 2006, section 8.1). A difference is trusted
where differences at neighbouring steps agree with it and none at a smaller step contradicts it by more than the noise
of the cost explains. On an amplifying rollout, differences at wide steps may agree without approximating the
derivative.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

Function = Callable[[np.ndarray], np.ndarray]
"""Of arrays: costs ``(B,)`` of columns ``(d, B)``, a gradient ``(d,)`` at a theta ``(d,)``, or costs ``(n,)`` at n places on a line."""
EPS = np.logspace(-2, -10, 17)
"""Step sizes, two per decade, in units of the natural scale."""
SINGLE_EPS = np.logspace(-1, -7, 13)
"""Steps in single precision: the best is near 5e-3."""
FINE = np.logspace(-2, -13, 23)
"""Steps for directions that :data:`EPS` leaves unsettled, as on a long rollout that amplifies."""
CONVERGING, ORDER = 8, 1.5
"""Neighbouring steps over which differences approach a derivative of 0, and the least order in the step."""
GUARD = 64.0
"""Allowed rounding error of a rollout's cost and of displaced thetas, in unit roundoffs."""
MEASURED = 8.0
"""Allowed error of a cost whose noise is measured, in standard deviations of the noise and in unit roundoffs."""
NOISY = 80.0
"""Error of a difference, in multiples of its rounding, above which the cost has noise of its own."""
RISE = 0.01
"""Relative error above which the difference at a large step counts as inaccurate."""
DECADES = 3.0
"""Decades of steps over which the change of slope at a kink must be constant."""
SHORT_WINDOW = 4
"""Neighbouring steps over which a slope must be constant in an exploding rollout, and a jump at the smallest steps."""
ALIKE = 0.1
"""Relative spread within which values count as equal."""
CHANCE = 10.0
"""Multiple of the smallest spread of neighbouring differences that counts as their error: it is partly small by chance."""
LARGEST = 1e-3
"""Largest relative error that counts as that of a difference in single precision, or of a gradient by rounding theta."""
MIN_STEPS = 7
"""Fewest steps with finite costs on both sides; with fewer, the verdict is ``nonfinite``."""


@dataclass(frozen=True)
class Sample:
    """Costs at displacements of a point along one direction, and the program's derivative at the point.

    ``step (K,)`` are displacements in falling order, ``minus`` and ``plus (K,)`` the costs at -step and +step, and
    ``centre`` is the cost at the point. ``crossing (K,)`` marks steps whose two sides differ in contact mode. ``scale``
    is the size of theta, and ``unit`` the unit roundoff of the program's arithmetic. ``noise`` is the measured standard
    deviation of the cost's noise, ``doubt`` the rounding error of the program's derivative, and ``moved`` the change of
    the program's derivative where theta changes in its last digits.
    """

    step: np.ndarray
    minus: np.ndarray
    centre: float
    plus: np.ndarray
    derivative: float
    crossing: np.ndarray
    repeatable: bool = True
    scale: float = 1.0
    unit: float = float(np.finfo(np.float64).eps)
    noise: float = 0.0
    doubt: float = 0.0
    moved: float = 0.0

    @property
    def differences(self) -> np.ndarray:
        """Central differences, ``(K,)``."""
        with np.errstate(over="ignore", invalid="ignore"):
            return (self.plus - self.minus) / (2.0 * self.step)

    @property
    def right(self) -> np.ndarray:
        """One-sided slopes towards plus, ``(K,)``."""
        return (self.plus - self.centre) / self.step

    @property
    def left(self) -> np.ndarray:
        """One-sided slopes towards minus, ``(K,)``."""
        return (self.centre - self.minus) / self.step

    @property
    def errors(self) -> np.ndarray:
        """|a - b| / max(1, |a|, |b|) of derivative and differences, ``(K,)``."""
        a, b = self.derivative, self.differences
        return np.abs(a - b) / np.maximum(np.maximum(1.0, abs(a)), np.abs(b))

    @property
    def finite(self) -> np.ndarray:
        """Whether both costs are finite at each step, boolean ``(K,)``."""
        return np.isfinite(self.minus) & np.isfinite(self.plus)

    def rounding(self, unit: float) -> np.ndarray:
        """Return the error of the differences that rounding explains at unit roundoff ``unit``, ``(K,)``."""
        costs = np.maximum(np.maximum(np.abs(self.minus), np.abs(self.plus)), abs(self.centre))
        # numbers below the smallest normal one have no relative precision
        costs = costs + float(np.finfo(np.float64).tiny) / unit
        # rounding theta changes the cost by the slope times the rounding; at a minimum, the slope is that of one side
        slopes = np.maximum(np.abs(self.left), np.abs(self.right))
        return MEASURED * unit * (costs + slopes * self.scale) / self.step

    @property
    def uncertainty(self) -> np.ndarray:
        """The error of the differences that rounding and measured noise explain, ``(K,)``."""
        return self.rounding(self.unit) + MEASURED * self.noise / self.step

    def size(self, index: int) -> float:
        """Return the larger of |derivative| and |difference| at one step, to which relative errors refer."""
        return max(abs(self.derivative), abs(float(self.differences[index])))


@dataclass(frozen=True)
class Finding:
    """A verdict, and the numbers that support it; NaN where a verdict has no numbers.

    ``difference`` is the trusted slope, with its ``uncertainty``, at ``step``. ``left`` and ``right`` are the one-sided
    slopes at this step. For a kink, it resolves the kink best.
    """

    verdict: str
    step: float = float("nan")
    difference: float = float("nan")
    uncertainty: float = float("nan")
    left: float = float("nan")
    right: float = float("nan")


def step_sizes(unit: float) -> np.ndarray:
    """Return the step sizes of a check in arithmetic of a unit roundoff, in units of the natural scale."""
    return EPS if unit < 1e-10 else SINGLE_EPS


def best(sample: Sample) -> int:
    """Return the index of the step with the smallest error; 0 when every error is NaN."""
    # argmin treats NaN as the smallest number
    return int(np.argmin(np.nan_to_num(sample.errors, nan=np.inf)))


def judge(sample: Sample) -> Finding:
    """Return the verdict on the program's derivative, from differences of the cost, and its numbers.

    - ``nondeterministic``: the same call returns another cost. ``nonfinite``: the cost at the point or at too many
      steps is NaN or infinite. ``nan_gradient``: only the derivative is NaN or infinite.
    - ``zero``: derivative and differences are exactly 0. ``disconnected``: only the derivative is exactly 0.
    - ``jump``: at the smallest steps, the costs on the two sides differ by a constant. ``kink``: the one-sided slopes
      differ by a constant over three decades of steps, and the derivative lies between them. Where the slopes are
      constant over fewer steps, as in an exploding rollout, and the two sides have different contacts, the derivative
      must equal one of the slopes.
    - ``unsettled``: the differences agree at no step, or differences at smaller steps contradict them.
    - ``wrong_adjoint``: the differences agree on a value other than the derivative.
    - Verdicts on a right derivative: ``saturated`` if derivative and differences are exactly 0 at the smallest steps
      only. ``rounding`` if differences at small steps have more error than the arithmetic explains.
      ``mode_crossing`` if differences at large steps are inaccurate and the contact mode changes, ``nonlinear`` if it
      does not. Otherwise ``smooth``.
    """
    if not sample.repeatable:
        return Finding("nondeterministic", float(sample.step[0]))
    finite = sample.finite
    if not np.isfinite(sample.centre) or finite.sum() < MIN_STEPS:
        return Finding("nonfinite", float(sample.step[0]))
    parts = {name: getattr(sample, name)[finite] for name in ("step", "minus", "plus", "crossing")}
    with np.errstate(over="ignore", invalid="ignore"):
        return _judge(replace(sample, **parts))


def _judge(sample: Sample) -> Finding:
    if not np.isfinite(sample.derivative):
        noise = sample.uncertainty
        index, spread = plateau(sample, noise)
        return finding_at(sample, "nan_gradient", index, spread + float(noise[index]))
    still = (sample.plus == sample.centre) & (sample.minus == sample.centre)
    if sample.derivative == 0.0 and still.all():
        return finding_at(sample, "zero", 0, float(sample.uncertainty[0]))
    noise = sample.uncertainty
    if _has_jump(sample, noise):
        return finding_at(sample, "jump", sample.step.size - 1, float("nan"))
    bend = sample.right - sample.left
    kink = _last_stable_index(sample.step, bend, 2.0 * noise)
    if kink is not None:
        return finding_at(
            sample, "kink" if _is_between_slopes(sample, noise) else wrong(sample), kink, float(noise[kink])
        )
    index, spread = plateau(sample, noise)
    uncertainty = spread + float(noise[index])
    doubt = sample.doubt + min(sample.moved, max(_change_of_slope(sample, noise, index), LARGEST * sample.size(index)))
    tolerance = CHANCE * spread + float(noise[index]) + resolution(sample.unit) * sample.size(index) + doubt
    apart = abs(float(sample.differences[index]) - sample.derivative)
    alike, rounding = ALIKE * sample.size(index), GUARD * float(sample.rounding(sample.unit)[index])
    resolved = uncertainty <= max(alike, rounding)
    # a tolerance as large as the derivative would accept half of the derivative
    if apart <= min(tolerance, alike + rounding + doubt) and resolved:
        return finding_at(sample, _classify_right(sample, index, still), index, uncertainty)
    if sample.crossing[index]:
        return finding_at(sample, _judge_one_sided(sample, noise), index, uncertainty)
    if sample.derivative == 0.0 and _vanishes(sample, noise):
        return finding_at(sample, "nonlinear", int(np.argmin(np.abs(sample.differences) + noise)), uncertainty)
    settled = apart > tolerance and _is_credible(sample, index, uncertainty, tolerance)
    return finding_at(sample, wrong(sample) if settled else "unsettled", index, uncertainty)


def finding_at(sample: Sample, verdict: str, index: int, uncertainty: float) -> Finding:
    """Return a verdict with the numbers of one step."""
    numbers = (float(values[index]) for values in (sample.step, sample.differences, sample.left, sample.right))
    step, difference, left, right = numbers
    return Finding(verdict, step, difference, uncertainty, left, right)


def plateau(sample: Sample, noise: np.ndarray) -> tuple[int, float]:
    """Return the index of the most reliable difference, and its disagreement with differences at neighbouring steps.

    Noise counts as disagreement when steps are compared, because differences rounded to 0 agree by accident. Excluded
    are steps that a smaller step contradicts, and, if three other steps remain, steps across which the contact mode
    changes.
    """
    differences = sample.differences
    between = np.abs(np.diff(differences))
    spread = np.fmax(np.r_[between[0], between], np.r_[between, between[-1]])  # the largest distance from a neighbour
    apart = np.abs(differences[:, None] - differences)
    allowed = 3.0 * spread[:, None] + noise[:, None] + 2.0 * noise
    contradicted = (np.triu(apart > allowed, 1)).any(axis=1)
    worth = spread + noise
    worth = np.where(contradicted, np.inf, worth)
    if (~sample.crossing & np.isfinite(worth)).sum() >= 3:
        worth = np.where(sample.crossing, np.inf, worth)
    if sample.derivative != 0.0 and differences.any() and (np.isfinite(worth) & (differences != 0.0)).any():
        worth = np.where(differences == 0.0, np.inf, worth)
    index = int(np.argmin(worth))
    return index, float(spread[index])


def _change_of_slope(sample: Sample, noise: np.ndarray, index: int) -> float:
    """Return by how much the cost's own slope changes from side to side, at the smallest step that noise allows.

    A derivative that changes with the last digits of theta is that of a cost whose slope does. Where the cost has one
    slope, as at a node of a table, such a derivative is wrong at theta.
    """
    bend = np.abs(sample.right - sample.left)[index:]
    resolved = bend[bend > 2.0 * noise[index:]]
    return float(resolved[-1]) if resolved.size else 0.0


def _is_credible(sample: Sample, index: int, uncertainty: float, tolerance: float) -> bool:
    """Return whether differences that contradict the derivative are reliable.

    Where the noise exceeds rounding, as in an amplifying rollout, the differences must agree to within ALIKE of their
    own size over SHORT_WINDOW neighbouring steps. Elsewhere, a distance of twice the tolerance from the derivative is
    enough.
    """
    differences = sample.differences
    near = np.abs(differences - differences[index]) <= ALIKE * abs(differences[index])
    lasting = np.asarray(_windows(near, SHORT_WINDOW).all(axis=1))
    settled = bool(lasting[max(0, index - SHORT_WINDOW + 1) : index + 1].any())
    if settled and uncertainty <= ALIKE * abs(differences[index]):
        return True
    plain = sample.noise / sample.step[index] <= sample.rounding(sample.unit)[index]
    return bool(plain and abs(differences[index] - sample.derivative) > 2.0 * tolerance)


def _judge_one_sided(sample: Sample, noise: np.ndarray) -> str:
    """Return the verdict from one-sided slopes, for differences whose two sides have different contacts.

    A slope is settled where it is constant over SHORT_WINDOW neighbouring steps. In an exploding rollout, slopes settle
    only at the smallest steps, where rounding is amplified like the state, and over fewer steps than a kink needs.
    """
    settled = False
    for slopes in (sample.left, sample.right):
        for window, noises in zip(_windows(slopes, SHORT_WINDOW), _windows(noise, SHORT_WINDOW)[:, -1], strict=True):
            middle, spread = float(np.median(window)), float(np.ptp(window))
            if spread + noises > ALIKE * abs(middle):
                continue
            settled = True
            tolerance = 2.0 * spread + noises + resolution(sample.unit) * abs(middle)
            if abs(middle - sample.derivative) <= tolerance:
                return "kink"
    return wrong(sample) if settled else "unsettled"


def _vanishes(sample: Sample, noise: np.ndarray) -> bool:
    """Return whether differences fall to 0 with at least order 1.5 of the step, down to the smallest that noise allows.

    An example is x^3 at 0, whose differences all differ.
    """
    sizes = np.abs(sample.differences)
    resolved = np.flatnonzero(sizes > noise)
    if resolved.size < CONVERGING or not np.array_equal(resolved, np.arange(resolved.size)):
        return False
    last = resolved[-CONVERGING:]
    orders = np.diff(np.log(sizes[last])) / np.diff(np.log(sample.step[last]))
    return bool((orders >= ORDER).all())


def resolution(unit: float) -> float:
    """Return the relative error below which no derivative is wrong: at the relative step u^(1/3) two errors balance."""
    return min(float(np.cbrt(unit)), LARGEST)


def wrong(sample: Sample) -> str:
    """Return the verdict on a derivative that is not the difference."""
    return "disconnected" if sample.derivative == 0.0 else "wrong_adjoint"


def _is_between_slopes(sample: Sample, noise: np.ndarray) -> bool:
    """Return whether the derivative lies between the one-sided slopes at the smallest step that rounding resolves.

    The tolerance of a slope is its change from the previous step, which exceeds the slope's error of order h.
    """
    resolved = [i for i in range(1, noise.size) if noise[i] <= resolution(sample.unit) * sample.size(i)]
    finest = resolved[-1] if resolved else int(np.argmin(noise[1:])) + 1
    slopes = [(side[finest], abs(side[finest] - side[finest - 1])) for side in (sample.left, sample.right)]
    tolerance = noise[finest] + resolution(sample.unit) * sample.size(finest)
    low = min(slope - change for slope, change in slopes) - tolerance
    high = max(slope + change for slope, change in slopes) + tolerance
    return bool(low <= sample.derivative <= high)


def _has_jump(sample: Sample, noise: np.ndarray) -> bool:
    """Return whether the cost jumps at theta: a difference of costs does not vanish as the step shrinks.

    Differences at two neighbouring steps yield the limit at step 0, since the part linear in the step cancels. The
    limit must be constant over the SHORT_WINDOW + 1 smallest steps, and exceed the noise. Unlike
    :func:`bench.measure.jumps.largest_jump`, this needs no further costs.
    """
    height = noise * sample.step
    ratio = sample.step[:-1] / sample.step[1:]
    for rise in (sample.plus - sample.minus, sample.plus - sample.centre, sample.centre - sample.minus):
        limits = ((ratio * rise[1:] - rise[:-1]) / (ratio - 1.0))[-SHORT_WINDOW:]
        error = 2.0 * ((ratio * height[1:] + height[:-1]) / (ratio - 1.0))[-SHORT_WINDOW:]
        middle = abs(float(np.median(limits)))
        if np.ptp(limits) <= ALIKE * middle + error.max() and middle > 2.0 * error.max():
            return True
    return False


def _last_stable_index(step: np.ndarray, values: np.ndarray, noise: np.ndarray) -> int | None:
    """Return the last index of the last window of values that is constant to within ``ALIKE`` and exceeds the noise.

    A window is :data:`DECADES` of steps long. None without such a window. A window does not count where values at smaller
    steps contradict it by more than their own noise.
    """
    size = min(1 + round(DECADES / float(np.log10(step[0] / step[1]))), values.size)
    windows, noises = _windows(values, size), _windows(noise, size).max(axis=1)
    middles = np.median(windows, axis=1)
    for start in range(len(windows) - 1, -1, -1):
        middle = float(middles[start])
        if np.ptp(windows[start]) > ALIKE * abs(middle) or abs(middle) <= noises[start]:
            continue
        after = slice(start + size, None)
        if (np.abs(values[after] - middle) <= ALIKE * abs(middle) + 2.0 * noise[after]).all():
            return start + size - 1
    return None


def _windows(values: np.ndarray, size: int) -> np.ndarray:
    """Return every window of ``size`` neighbouring values, ``(K - size + 1, size)``."""
    return np.lib.stride_tricks.sliding_window_view(values, size)


def _classify_right(sample: Sample, index: int, still: np.ndarray) -> str:
    """Return the verdict on a right derivative, from the errors of the differences at small and at large steps."""
    if sample.derivative == 0.0 and still[-MIN_STEPS:].all():
        return "saturated"
    errors = np.abs(sample.differences - sample.derivative)
    small = np.arange(errors.size) > index
    if (errors > NOISY * sample.rounding(sample.unit))[small].sum() >= 3:
        return "rounding"
    risen = (errors > RISE * sample.size(index)) & ~small & (errors > sample.uncertainty)
    if (risen & sample.crossing).any():
        return "mode_crossing"
    return "nonlinear" if risen.any() else "smooth"
