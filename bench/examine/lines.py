"""Finds jumps and kinks of a cost on a line, by halving intervals around the places where its slope changes most.

Where the slope changes by D over a width h, D falls like h for a smooth cost, is constant at a kink and grows like 1/h
at a jump. The order in h over the halvings identifies the kind, so no threshold on the size of a change is needed. The
search for one jump, :func:`bench.measure.jumps.largest_jump`, divides all lines together and needs a thousand costs per
level. This search follows each place separately with two costs per halving, since a user's simulator may be slow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.gradient.direction import Function

POINTS = 97
"""Number of points of a scan. Not a power of 2 plus one, so that points rarely coincide with round numbers."""
REACH = 4.0
"""Distance searched on either side of theta, in standard deviations of the noise, as :data:`bench.measure.jumps.REACH`."""
HALVINGS = 14
"""Number of halvings of an interval."""
PLACES = 6
"""Most places searched on a line: those where the change of slope stands out most from its neighbours."""
TREADS = 4
"""Fewest equal jumps on one line that count as a staircase."""
ALIKE = 0.01
"""Relative difference between heights of jumps that count as equal; the slope of the cost adds to each height."""
EVEN = 0.02
"""Largest deviation from even spacing of the jumps of a staircase, as a share of the spacing."""
LEAST = 1e-12
"""Smallest break that is searched, as a share of the cost's change along the line over :data:`GUARD`."""
SIDES = 4
"""Points on either side of a break that confirm it."""
WIDER = 3.0
"""Spacing of these points, in multiples of the last width."""
CONFIRMED = 0.1
"""Largest deviation of the cost from smoothness on either side of a break, as a share of the break."""
GUARD = 64.0
"""Multiple of the cost's rounding error that a change of slope has to exceed."""


@dataclass(frozen=True)
class Break:
    """A place where a cost has no derivative."""

    kind: str
    """``jump`` or ``kink``."""
    at: float
    """Position t on the line ``theta + t * direction``."""
    size: float
    """The height of a jump, or the change of slope per unit of t at a kink."""


@dataclass(frozen=True)
class LineScan:
    """A cost along ``theta + t * direction``."""

    direction: np.ndarray
    """``(d,)``."""
    at: np.ndarray
    """Values of t, ``(n,)``."""
    costs: np.ndarray
    """``(n,)``."""
    breaks: tuple[Break, ...]
    steps: bool
    """Whether the cost is constant between jumps everywhere: a staircase."""
    missed: float = float("nan")
    """Share of the cost's change along the line that the integral of the gradient misses; NaN if unknown."""
    n_lost: int = 0
    """Number of points at which the gradient is not a number, and the cost is one."""

    @property
    def jumps(self) -> tuple[Break, ...]:
        """The jumps."""
        return tuple(b for b in self.breaks if b.kind == "jump")

    @property
    def tread(self) -> float:
        """The common height of all jumps, if there are at least four, of equal height and evenly spaced; else 0.

        Only the six largest jumps are known, so distances may be multiples of the smallest distance. Four random jumps
        are evenly spaced by chance less than once in 500 times, and rarely have equal heights too.
        """
        heights, at = np.array([b.size for b in self.jumps]), np.array([b.at for b in self.jumps])
        if heights.size < TREADS or np.ptp(heights) > ALIKE * heights.max():
            return 0.0
        gaps = np.diff(at) / np.diff(at).min()
        return float(heights.mean()) if (np.abs(gaps - np.round(gaps)) < EVEN).all() else 0.0


def scan(
    along: Function,
    direction: np.ndarray,
    noise: float,
    reach: float = REACH,
    effort: tuple[int, int, int] = (POINTS, HALVINGS, PLACES),
    unit: float = float(np.finfo(np.float64).eps),
) -> LineScan:
    """Return a scan of the cost ``along(t)``, ``(n,)`` to ``(n,)``, on ``theta + t * direction`` for t from -reach to +reach.

    ``noise`` is the size of the cost's rounding errors at theta, and ``unit`` the unit roundoff, from which they follow
    elsewhere. ``effort`` is the number of points, of halvings, and the most places that are searched for breaks.
    """
    points, halvings, most = effort
    t = np.linspace(-reach, reach, points)
    f = along(t)
    finite = f[np.isfinite(f)]
    # a break that is this small beside the cost or its change is rounding
    noise = max(
        noise, unit * float(np.abs(finite).max(initial=0.0)), LEAST * float(np.ptp(finite)) if finite.size else 0.0
    )
    bends = np.diff(f, 2)
    padded = np.pad(bends, 1, mode="edge")
    # from the mean of the neighbours, so that no smooth bend hides a small jump
    turns = np.abs(bends - (padded[:-2] + padded[2:]) / 2)
    turns = np.where(np.isfinite(turns), turns, np.abs(bends))  # beside costs that are not numbers
    order = np.argsort(np.nan_to_num(turns, nan=-1.0, posinf=-1.0))[::-1]
    places: list[int] = []
    for index in order:
        if len(places) < most and turns[index] > GUARD * noise and all(abs(index - p) > 1 for p in places):
            places.append(int(index))
    breaks = _locate_breaks(along, t, f, places, halvings, noise) if places else []
    level = np.diff(f)
    steps = bool(level.any() and (np.abs(level) <= noise).mean() > 0.5 and any(b.kind == "jump" for b in breaks))
    return LineScan(direction, t, f, tuple(sorted(breaks, key=lambda b: b.at)), steps)


def _locate_breaks(
    along: Function,
    t: np.ndarray,
    f: np.ndarray,
    places: list[int],
    halvings: int,
    noise: float,
) -> list[Break]:
    """Return the breaks at the given places, found by halving the intervals around all places together."""
    centre, width = t[np.array(places) + 1], float(t[1] - t[0])
    values = np.stack([f[i : i + 3] for i in places])  # left, middle, right
    changes = [np.abs(np.diff(values, 2))[:, 0]]
    bends = [changes[0] / width]  # changes of slope: over all five points, as a kink may not be in the middle of three
    for _ in range(halvings):
        between = along(np.concatenate([centre - width / 2, centre + width / 2])).reshape(2, -1).T
        five = np.insert(values, [1, 2], between, axis=1)
        turns, width = np.abs(np.diff(five, 2)), width / 2
        best = np.argmax(np.nan_to_num(turns, nan=-1.0), axis=1)[:, None]
        bends.append(np.abs((five[:, 4] - five[:, 3]) - (five[:, 1] - five[:, 0])) / width)
        centre = centre + (best[:, 0] - 1) * width
        values = np.take_along_axis(five, best + np.arange(3), axis=1)
        changes.append(np.take_along_axis(turns, best, axis=1)[:, 0])
    found, widths = list[tuple[Break, float]](), float(t[1] - t[0]) * 0.5 ** np.arange(len(changes))
    # second differences by width are of order 2 for a smooth cost, 1 for a kink, 0 for a jump
    for at, change, bend in zip(centre.tolist(), np.array(changes).T, np.array(bends).T, strict=True):
        clear = int(np.argmin([*(change > GUARD * noise), False]))
        last = slice(max(clear - 6, 0), clear)
        order = np.polyfit(np.log2(widths[last]), np.log2(change[last]), 1)[0] if clear >= 5 else 2.0
        kind, sizes = ("jump", change) if order < 0.5 else ("kink", bend)
        if order < 1.5:
            found.append((Break(kind, at, float(sizes[clear - 1])), float(widths[clear - 1])))
    kept: list[Break] = []  # of two at one place a jump, not a kink
    for one in sorted(_confirmed(along, found, noise), key=lambda b: b.kind):
        if all(abs(one.at - other.at) > 4 * widths[-1] for other in kept):
            kept.append(one)
    return kept


def _confirmed(along: Function, found: list[tuple[Break, float]], noise: float) -> list[Break]:
    """Return the breaks on both sides of which the cost is smooth, from four more costs on each side.

    A rough cost has second differences of every size, which look like jumps. Beside a jump its values scatter as much as
    across, and beside a kink its slopes do.
    """
    away, confirmed = WIDER * np.arange(1, SIDES + 1), []
    at = [one.at + width * np.concatenate([-away, away]) for one, width in found]
    sides = along(np.concatenate(at)).reshape(-1, 2, SIDES) if found else np.empty((0, 2, SIDES))
    for (one, width), both in zip(found, sides, strict=True):
        size = one.size if one.kind == "jump" else one.size * width * WIDER
        if np.abs(np.diff(both, 2)).max() <= CONFIRMED * size + 4.0 * noise:
            confirmed.append(one)
    return confirmed
