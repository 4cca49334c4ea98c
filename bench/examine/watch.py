"""Checks the gradients of somebody's own optimization loop while it runs, within a share of the loop's time."""

from __future__ import annotations

import csv
import math
import random
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import UserError, needing_sweeps
from bench.examine.few import ROUNDED, ROUNDS, FewSteps
from bench.examine.lines import scan
from bench.examine.subspace import Group, Subspace
from bench.gradient import FAULTS, RULES, TRUSTED
from bench.measure.statistics import ends
from bench.simulator.simulator import Simulator, reason_of
from bench.simulator.tree import ParameterTree, numbers

EQUAL = 4
"""Equal calls of the cost, whose range is its noise: two calls are often close together by chance."""
PAIRS = 8
"""Mirrored pairs of a zeroth-order estimate."""
SHARES = np.array([1.0, 0.1, 0.01])
"""Shares of the last step's length at which a step against the gradient is tried."""
LINE = (9, 6, 1)
"""Points, halvings and places of the search for jumps along the last step."""
FIRST_STEP = 1e-3
"""Length of a step before the first one, in units of the scale of theta."""
COMPILING = 2
"""First checks that do not count in the share: a cost in JAX compiles at both if arrays change their type in an update."""
COLUMNS = (
    *("iteration", "cost", "noise", "precision", "gradient_norm", "gradient_spread", "verdict", "error"),
    *("ratio", "ratio_low", "ratio_high", "cosine", "cosine_low", "cosine_high"),
    *("jumps", "largest_jump", "lowers", "seconds", "reason"),
)
USABLE = 0.1
"""Largest relative error of a slope along a gradient of use, as in the log of a training."""
LARGER, EARLIER = 200.0, 3
"""Factor on the largest norm of at least this number of earlier rows above which a gradient explodes."""
MEANINGS = {
    "opposed": f"the cosine of the gradient with a zeroth-order estimate is certainly below 0 in {EARLIER} checks in a row",
    "not_finite": "theta or its gradient is not finite",
    "explodes": f"the norm is more than {LARGER:g} times the largest before",
}
"""Why a gradient is of no use, beside the faults of a check."""


class Watch:
    """A log of an optimization loop, ``bench.watch``: called as ``log(theta, gradient)`` in every iteration, it checks some.

    ``cost(theta)`` returns one number, or ``cost(theta, w)`` where the calls pass what else belongs to the gradient, ``w``.
    Every ``every`` iterations the norm of the gradient is noted, and the gradient is checked unless that would take more than
    ``share`` of the loop's time, without the first two checks, which may compile. JAX compiles only a cost that is compiled
    itself, ``jax.jit(cost)``. ``out`` is a CSV file of the rows. ``str()`` names the first noted iteration at which the
    gradient was of no use. Raises :class:`UserError` for other arguments, and OSError where ``out`` cannot be written.

    ``rows`` has a line per noted iteration: the norm of the gradient and its distance from the one before, relative to the
    norm, and, where it was checked, the verdict along itself and a random direction with its largest relative error, the range of
    equal calls of the cost, ratio and cosine of a zeroth-order estimate from mirrored pairs to the gradient, with 95%
    intervals, the jumps along the last step, and the share of its length at which a step against the gradient lowers the cost
    (0: at none).

    >>> log = Watch(lambda x: float(x @ x), every=1, share=math.inf)
    >>> log(np.array([1.0, 2.0]), np.array([2.0, 4.0]))
    >>> print(log)
    1 of 1 iterations checked (1 smooth): no fault above 10%
    """

    def __init__(
        self, cost: Callable[..., Any], every: int = 50, out: str | Path | None = None, share: float = 0.1
    ) -> None:
        for is_valid, text in (
            (callable(cost), f"cost={cost!r} is not a function of theta"),
            (isinstance(every, Integral) and every > 0, f"every={every!r} is not a whole number above 0"),
            (isinstance(share, Real) and share > 0, f"share={share!r} is not a number above 0"),
        ):
            if not is_valid:
                raise UserError(text)
        self.cost, self.every, self.share, self.out = cost, every, share, out
        if out:
            with open(out, "a"):
                pass
        self.rows: list[dict[str, Any]] = []
        self.iteration = -1
        """The last iteration, counted from 0."""
        self._before = [np.empty(0)] * 2
        self._began = time.perf_counter()
        self._written, self._unwritten = 0, ""

    def __call__(self, theta: Any, gradient: Any, w: Any = None) -> None:
        """Count an iteration; if it is due, note the gradient's norm, and check the gradient if the share of time allows.

        ``theta`` and ``gradient`` have the same structure: an array, or nested dicts and lists of arrays. ``w`` is what the
        gradient was computed with, such as noise, a batch or a state; the cost is then called as ``cost(theta, w)``. Never
        raises, and changes neither theta nor the state of random generators.
        """
        self.iteration += 1
        if self.iteration % self.every == 0:
            self._note(theta, gradient, *() if w is None else (w,))
        if (self.iteration + 1) % self.every == 0:
            with suppress(Exception):  # such as a buffer that the loop has given away
                self._before = [numbers(theta).copy(), numbers(gradient).copy()]

    def _note(self, theta: Any, gradient: Any, *given: Any) -> None:
        """Add a row on the gradient at theta, and write it."""
        began = time.perf_counter()
        row: dict[str, Any] = dict.fromkeys(COLUMNS, math.nan) | {
            "iteration": self.iteration,
            "verdict": "",
            "reason": "",
        }
        with _same_random_numbers(), np.errstate(all="ignore"):
            try:
                self._measure(row, theta, gradient, given)
            except Exception as error:
                row["reason"] = reason_of(error)
        row["seconds"] = time.perf_counter() - began
        self.rows.append(row)
        if not self.out:
            return
        lines = [one.values() for one in self.rows[self._written :]]
        try:
            with open(self.out, "a" if self._written else "w", newline="") as file:
                csv.writer(file).writerows(lines if self._written else [COLUMNS, *lines])
            self._written, self._unwritten = len(self.rows), ""
        except OSError as error:
            self._unwritten = f", {self.out} cannot be written: {error}"

    def _measure(self, row: dict[str, Any], theta: Any, gradient: Any, given: tuple[Any, ...]) -> None:
        """Add what is known of theta and its gradient to a row."""
        with suppress(TypeError):  # of what is not numbers, which the next line names
            if not np.isfinite(numbers(theta)).all():
                return
        layout, slopes, last = ParameterTree(theta), numbers(gradient), self._before
        if last[1].size == slopes.size:
            row["gradient_spread"] = float(np.linalg.norm(slopes - last[1]) / np.linalg.norm(slopes))
        slopes = layout.flatten(gradient).astype(np.float64)
        row["gradient_norm"] = float(np.linalg.norm(slopes))
        seconds = [one["seconds"] for one in self.rows]
        loop, counted = time.perf_counter() - self._began - sum(seconds[:COMPILING]), seconds[COMPILING:]
        if sum(counted) + max(counted, default=0.0) > self.share * loop:
            return
        simulator = Simulator(lambda x: self.cost(x, *given), layout, compiles=False)
        has_moved = last[0].size == layout.vector.size and (last[0] != layout.vector).any()
        step = layout.vector - last[0] if has_moved else FIRST_STEP * layout.scales()
        row |= _compare(simulator, slopes, step, np.random.default_rng(self.iteration))
        row["reason"] = next(iter(simulator.raised["costs"]), "")

    @property
    def first(self) -> tuple[int, str] | None:
        """The first noted iteration at which the gradient was of no use, and the reason; None if there is none."""
        checked: list[dict[str, Any]] = []
        largest = 0.0
        for k, row in enumerate(self.rows):
            checked += [row] * bool(row["verdict"])
            last = checked[-EARLIER:] if len(checked) >= EARLIER else []
            is_lasting = bool(last) and all(one["verdict"] in FAULTS for one in last)
            reasons = {
                row["verdict"]: row["verdict"] in FAULTS and (is_lasting or not row["error"] <= USABLE),
                "not_finite": not (row["reason"] or math.isfinite(row["gradient_norm"])),
                "opposed": bool(last) and all(one["cosine_high"] < 0.0 for one in last),
                "explodes": k >= EARLIER and row["gradient_norm"] > LARGER * largest,
            }
            for reason in filter(reasons.get, reasons):
                return row["iteration"], reason
            largest = np.fmax(largest, row["gradient_norm"])
        return None

    def __str__(self) -> str:
        verdicts = Counter(row["verdict"] for row in self.rows if row["verdict"])
        counts = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items()) or "none"
        text = f"{verdicts.total()} of {self.iteration + 1} iterations checked ({counts})"
        if reasons := [row["reason"] for row in self.rows if row["reason"]]:
            text += f", {len(reasons)} with errors: {reasons[0]}"
        text += self._unwritten
        if self.first is None:
            return f"{text}: {f'no fault above {USABLE:.0%}' if verdicts.keys() & TRUSTED else 'nothing is known of the gradient'}"
        iteration, code = self.first
        meaning = RULES[code].meaning if code in RULES else MEANINGS[code]
        return f"{text}: of no use from iteration {iteration} on ({code}: {meaning})"

    def draw(self, path: str | Path) -> None:
        """Write a chart of the log; needs the extra ``sweeps``."""
        with needing_sweeps("a chart"):
            import pandas as pd

            from bench.experiment.columns import Column, interval
            from bench.experiment.views import Chart, Mark
            from bench.report.draw import draw

        x, y = (
            [Column("iteration", log=False)],
            [Column("gradient_norm"), Column("error"), interval("cosine", log=False)],
        )
        marks = [Mark(code, at) for at, code in filter(None, [self.first])]
        frame = pd.DataFrame(self.rows or [dict.fromkeys(COLUMNS, math.nan)])
        draw(Chart("watch", frame, x, y, "points", marks=marks, own_scales=True)).savefig(path, dpi=150)


def _compare(simulator: Simulator, slopes: np.ndarray, step: np.ndarray, draw: np.random.Generator) -> dict[str, Any]:
    """Return what costs say of the gradient at theta: mirrored pairs, differences, and costs along the last step."""
    from scipy.special import stdtrit

    def along(vectors: np.ndarray) -> np.ndarray:
        return simulator.costs(at[:, None] + vectors)

    at, scale, length = simulator.layout.vector, simulator.layout.scales(), np.linalg.norm(step)
    values = along(np.zeros((at.size, EQUAL)))
    value, noise = float(values[0]), float(np.ptp(values))
    moved = draw.standard_normal((at.size, PAIRS)) * length / math.sqrt(at.size)
    of_gradient, of_costs = slopes @ moved, along(np.c_[moved, -moved]).reshape(2, PAIRS).T @ [0.5, -0.5]
    square = of_gradient @ of_gradient
    ratio = of_costs @ of_gradient / square
    error = np.linalg.norm(of_costs - ratio * of_gradient) / np.sqrt((PAIRS - 1) * square)
    ratios = ratio + stdtrit(PAIRS - 1, 0.975) * error * np.array([0.0, -1.0, 1.0])
    cosines = np.clip(ratios * np.sqrt(square / (of_costs @ of_costs)), -1.0, 1.0)

    if simulator.has_single_precision:  # behind a cost of double precision
        simulator.precision = "float32"
    unit = simulator.unit
    down = np.nan_to_num(-slopes * length / np.linalg.norm(slopes))  # 0 without a direction
    vectors = draw.standard_normal((2, at.size))
    if down.any():  # whose slope stands out most from rounding
        vectors[0] = scale * down
    groups = [Group("", 0, at.size, scale * one / np.linalg.norm(one)) for one in vectors]
    few = FewSteps(Subspace(simulator.layout, scale, [], groups), simulator.costs, slopes, value, unit, noise)
    for size in ROUNDS:
        few.run_round(size, simulator.width)
    checked = few.check()

    jumps = scan(lambda t: along(step[:, None] * (t - 1.0) / 2.0), step, noise, 1.0, LINE, unit).jumps
    changes = along(down[:, None] * SHARES) - value
    lowers = SHARES[changes < 0.0].max(initial=0.0)
    is_known = lowers or (changes > ROUNDED * (unit * abs(value) + noise)).all()
    return {
        "cost": value,
        "noise": noise,
        "precision": unit,
        "verdict": checked.cause,
        "error": max(part.error for part in checked.parts if part.verdict == checked.cause),
        "jumps": len(jumps),
        "largest_jump": max((jump.size for jump in jumps), default=0.0),
        "lowers": float(lowers) if is_known else math.nan,
        **ends("ratio", ratios.tolist()),
        **ends("cosine", cosines.tolist()),
    }


@contextmanager
def _same_random_numbers() -> Iterator[None]:
    """Restore the states of the global random generators of Python, NumPy and PyTorch afterwards."""
    torch = sys.modules.get("torch")
    devices = range(torch.cuda.device_count()) if torch and torch.cuda.is_initialized() else ()
    states = random.getstate(), np.random.get_state()  # noqa: NPY002
    with torch.random.fork_rng(devices) if torch else nullcontext():
        yield
    random.setstate(states[0])
    np.random.set_state(states[1])  # noqa: NPY002
