"""Checks the gradients of somebody's own optimization loop while it runs, within a share of the loop's time."""

from __future__ import annotations

import csv
import math
import random
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import UserError, failure, needing_sweeps
from bench.examine.few import ROUNDS, FewSteps
from bench.examine.lines import scan
from bench.examine.subspace import Group, Subspace
from bench.gradient import FAULTS, RULES
from bench.simulator.simulator import Simulator
from bench.simulator.tree import ParameterTree, numbers

Costs = Callable[[np.ndarray], np.ndarray]
"""Costs of columns: ``(d, B)`` to ``(B,)``."""
DIRECTIONS = 2
"""Random directions along which a gradient is compared with differences."""
PAIRS = 8
"""Mirrored pairs of a zeroth-order estimate."""
SHARES = (1.0, 0.1, 0.01)
"""Shares of the last step's length at which a step against the gradient is tried."""
LINE = (9, 6, 1)
"""Points, halvings and places of the search for jumps along the last step."""
FIRST_STEP = 1e-3
"""Length of a step before the first one, in units of the scale of theta."""
COLUMNS = (
    "iteration",
    "cost",
    "gradient_norm",
    "verdict",
    "error",
    "noise",
    "ratio",
    "ratio_low",
    "ratio_high",
    "cosine",
    "cosine_low",
    "cosine_high",
    "jumps",
    "largest_jump",
    "lowers",
    "costs",
    "seconds",
    "reason",
)
LARGER, EARLIER = 200.0, 3
"""Factor on the largest norm of at least this number of earlier checks above which a gradient explodes."""
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
    ``share`` of the loop's time, without the first check, which may compile. JAX compiles only a cost that is compiled itself,
    ``jax.jit(cost)``. ``out`` is a CSV file of the rows. ``str()`` names the first noted iteration at which the gradient was
    of no use.

    ``rows`` has a line per noted iteration: the norm of the gradient and, where it was checked, the verdict along random
    directions with the largest relative error, the difference of two equal calls of the cost, ratio and cosine of a
    zeroth-order estimate from mirrored pairs to the gradient, with 95% intervals, the jumps along the last step, and the share
    of its length at which a step against the gradient lowers the cost (0: at none).

    >>> log = Watch(lambda x: float(x @ x), every=1, share=math.inf)
    >>> log(np.array([1.0, 2.0]), np.array([2.0, 4.0]))
    >>> print(log)
    1 of 1 iterations checked: no fault of the gradient
    """

    def __init__(
        self,
        cost: Callable[..., Any],
        every: int = 50,
        out: str | Path | None = None,
        share: float = 0.1,
        seed: int = 0,
    ) -> None:
        if not callable(cost):
            raise UserError(f"the cost is a function of theta, not {type(cost).__name__}")
        if not (isinstance(every, int) and every > 0):
            raise UserError(f"every={every} is not a number of iterations: give a whole number above 0")
        if not share > 0:
            raise UserError(f"share={share} is not a share of the loop's time: give a number above 0, such as 0.1")
        self.cost, self.every, self.share, self.seed = cost, every, share, seed
        self.out = None if out is None else Path(out)
        self.rows: list[dict[str, Any]] = []
        self.iteration = -1
        """The last iteration, counted from 0."""
        self._simulator: Simulator | None = None
        self._given: tuple[Any, ...] = ()
        self._before = np.empty(0)
        self._began = time.perf_counter()
        self._spent = self._longest = 0.0
        self._written = 0
        self._unwritten = ""

    def __call__(self, theta: Any, gradient: Any, w: Any = None) -> None:
        """Count an iteration; if it is due, note the gradient's norm, and check the gradient if the share of time allows.

        ``theta`` and ``gradient`` have the same structure: an array, or nested dicts and lists of arrays. ``w`` is what the
        gradient was computed with, such as noise, a batch or a state; the cost is then called as ``cost(theta, w)``. Never
        raises, and changes neither theta nor the state of random generators.
        """
        self.iteration += 1
        if self.iteration % self.every == 0:
            self._check(theta, gradient, w)
        if (self.iteration + 1) % self.every == 0:
            with suppress(Exception):  # such as a buffer that the loop has given away
                self._before = numbers(theta).copy()

    def _check(self, theta: Any, gradient: Any, w: Any) -> None:
        """Add a row on the gradient at theta, and write it."""
        began = time.perf_counter()
        row: dict[str, Any] = dict.fromkeys(COLUMNS, math.nan) | {
            "iteration": self.iteration,
            "verdict": "",
            "reason": "",
        }
        with _same_random_numbers(), np.errstate(all="ignore"):
            try:
                self._measure(row, theta, gradient, w)
            except Exception as error:
                row["reason"] = failure(error)["reason"]
        taken = row["seconds"] = time.perf_counter() - began
        if self.rows:  # the first check may compile
            self._spent, self._longest = self._spent + taken, max(self._longest, taken)
        else:
            self._began += taken
        self.rows.append(row)
        if not self.out:
            return
        lines = [one.values() for one in self.rows[self._written :]]
        try:
            with self.out.open("a" if self._written else "w", newline="") as file:
                csv.writer(file).writerows(lines if self._written else [COLUMNS, *lines])
            self._written, self._unwritten = len(self.rows), ""
        except OSError as error:
            self._unwritten = f", {self.out} cannot be written: {error}"

    def _measure(self, row: dict[str, Any], theta: Any, gradient: Any, w: Any) -> None:
        """Add what is known of theta and its gradient to a row."""
        if not np.isfinite(numbers(theta)).all():
            return
        layout = ParameterTree(theta)
        slopes, self._given = layout.flatten(gradient), () if w is None else (w,)
        row["gradient_norm"] = float(np.linalg.norm(slopes))
        if self._spent + self._longest > self.share * (time.perf_counter() - self._began):
            return
        if self._simulator is None:
            self._simulator = Simulator(lambda x: self.cost(x, *self._given), layout, compiles=False)
        simulator, at, scale = self._simulator, layout.vector, layout.scales()
        before, costs = simulator.clock.counts["costs"], simulator.costs
        draw = np.random.default_rng([self.seed, self.iteration])
        vectors = [scale * (one / np.linalg.norm(one)) for one in draw.standard_normal((DIRECTIONS, at.size))]
        space = Subspace(layout, scale, [], [Group(f"direction {i}", 0, at.size, v) for i, v in enumerate(vectors)])
        value, again = (float(costs(at[:, None])[0]) for _ in range(2))
        noise = abs(again - value)
        few = FewSteps(space, costs, slopes, value, simulator.unit, noise)
        for size in ROUNDS:
            few.run_round(size, simulator.width)
        checked = few.check()
        row |= {
            "cost": value,
            "verdict": checked.cause,
            "error": max(part.error for part in checked.parts),
            "noise": noise,
        }
        if np.isfinite(slopes).all():
            has_moved = self._before.size == at.size and (self._before != at).any()
            step = at - self._before if has_moved else FIRST_STEP * scale
            row |= _pairs(costs, at, slopes, step, draw) | _along(costs, at, slopes, step, value, noise, simulator.unit)
        row["costs"] = simulator.clock.counts["costs"] - before

    @property
    def first(self) -> tuple[int, str] | None:
        """The first noted iteration at which the gradient was of no use, and the reason; None if there is none."""
        cosines: list[float] = []
        largest = 0.0
        for k, row in enumerate(self.rows):
            if row["costs"] > 0:
                cosines.append(row["cosine_high"])
            reasons = {
                row["verdict"]: row["verdict"] in FAULTS,
                "not_finite": not (row["reason"] or math.isfinite(row["gradient_norm"])),
                "opposed": sum(cosine < 0.0 for cosine in cosines[-EARLIER:]) == EARLIER,
                "explodes": k >= EARLIER and row["gradient_norm"] > LARGER * largest,
            }
            for reason in filter(reasons.get, reasons):
                return row["iteration"], reason
            largest = np.fmax(largest, row["gradient_norm"])
        return None

    def __str__(self) -> str:
        checks = f"{sum(row['costs'] > 0 for row in self.rows)} of {self.iteration + 1} iterations checked"
        failed = [row for row in self.rows if row["reason"]]
        text = (f"{checks}, {len(failed)} not: {failed[0]['reason']}" if failed else checks) + self._unwritten
        if self.first is None:
            return f"{text}: {'no fault of the gradient' if len(self.rows) > len(failed) else 'nothing is known of the gradient'}"
        iteration, code = self.first
        meaning = RULES[code].meaning if code in RULES else MEANINGS[code]
        return f"{text}: of no use from iteration {iteration} on ({code}: {meaning})"

    def draw(self, path: str | Path) -> Path:
        """Write a chart of the log and return its path; needs Matplotlib."""
        with needing_sweeps("a chart"):
            from matplotlib.figure import Figure

        figure = Figure(figsize=(7.0, 6.0), layout="constrained")
        scales = {"gradient_norm": "log", "error": "log", "cosine": "linear"}
        for panel, (name, scale) in zip(figure.subplots(3, sharex=True), scales.items(), strict=True):
            rows = [row for row in self.rows if math.isfinite(row[name])]
            at = [row["iteration"] for row in rows]
            panel.plot(at, [row[name] for row in rows], "o-")
            panel.set(ylabel=name.replace("_", " "), yscale=scale)
            if self.first is not None:
                panel.axvline(self.first[0], color="tab:red", label=self.first[1])
                panel.legend()
        low, high = ([row[f"cosine_{end}"] for row in rows] for end in ("low", "high"))
        panel.fill_between(at, low, high, alpha=0.2)
        panel.set_xlabel("iteration")
        figure.savefig(path, dpi=150)
        return Path(path)


def _pairs(
    costs: Costs, at: np.ndarray, slopes: np.ndarray, step: np.ndarray, draw: np.random.Generator
) -> dict[str, float]:
    """Return ratio and cosine of slopes of mirrored pairs to those of the gradient, with the intervals of a regression."""
    from scipy.special import stdtrit

    moved = draw.standard_normal((at.size, PAIRS)) * np.linalg.norm(step) / math.sqrt(at.size)
    both = costs(np.concatenate([at[:, None] + moved, at[:, None] - moved], axis=1)).reshape(2, PAIRS)
    of_costs, of_gradient = (both[0] - both[1]) / 2.0, slopes @ moved
    square, limit = float(of_gradient @ of_gradient), float(stdtrit(PAIRS - 1, 0.975))
    ratio = float(of_costs @ of_gradient) / square
    error = limit * float(np.linalg.norm(of_costs - ratio * of_gradient)) / math.sqrt((PAIRS - 1) * square)
    to_cosine = math.sqrt(square) / float(np.linalg.norm(of_costs))
    ends = {"": ratio, "_low": ratio - error, "_high": ratio + error}
    return {f"ratio{end}": value for end, value in ends.items()} | {
        f"cosine{end}": float(np.clip(value * to_cosine, -1.0, 1.0)) for end, value in ends.items()
    }


def _along(
    costs: Costs, at: np.ndarray, slopes: np.ndarray, step: np.ndarray, value: float, noise: float, unit: float
) -> dict[str, float]:
    """Return the jumps along the last step, and the share of its length at which a step against the gradient lowers the cost."""
    line = scan(lambda t: costs(at[:, None] + step[:, None] * (t - 1.0) / 2.0), step, noise, 1.0, LINE, unit)
    length, norm = float(np.linalg.norm(step)), float(np.linalg.norm(slopes))
    down = -slopes * (length / norm if norm else 0.0)
    changes = costs(at[:, None] + down[:, None] * np.array(SHARES)) - value
    rounding = 16.0 * (unit * abs(value) + noise)
    lowered = [share for share, change in zip(SHARES, changes, strict=True) if change < 0.0]
    is_known = bool((changes > rounding).all())
    return {
        "jumps": len(line.jumps),
        "largest_jump": max((jump.size for jump in line.jumps), default=0.0),
        "lowers": max(lowered, default=0.0 if is_known else math.nan),
    }


@contextmanager
def _same_random_numbers() -> Iterator[None]:
    """Restore the states of the global random generators of Python, NumPy and PyTorch afterwards."""
    torch = sys.modules.get("torch")
    states = random.getstate(), np.random.get_state(), torch and torch.random.get_rng_state()  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        if torch:
            torch.random.set_rng_state(states[2])
