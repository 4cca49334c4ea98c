"""Runs the examination: checks a cost and its gradient, in order, within one time budget."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bench.errors import UserError
from bench.examine.lines import HALVINGS, PLACES, POINTS, LineScan, scan
from bench.examine.report import Report
from bench.examine.smoothing import FEWEST, PAIRS, Smoothed, directions, measure_smoothed
from bench.measure.gradcheck import EPS, Check, Options, check
from bench.model.simulator.clock import Clock, OutOfTime, parse_duration
from bench.model.simulator.simulator import Simulator
from bench.model.simulator.tree import ParameterTree

GENERATED_SUFFIX = re.compile(r"_[0-9a-f]{8}$")
"""Suffix of the generated name of a module that is loaded from a file."""
RELATIVE = 0.01
"""Default sigma of the line scans, and of a cost with its own noise, in units of each input's scale."""
SHARES = {"check": 0.75, "again": 0.5, "lines": 0.3}
"""Share of the remaining time planned for each part; the next part may use the remainder. Lines may take twice theirs."""
POINTS_EACH = 2 * (2 * EPS.size + 17)
"""Approximate number of costs per checked direction."""
SCAN = 7 * 65
"""Number of costs of a staircase search along one direction that is not clearly right."""
EFFORTS = (
    Options(),
    Options(draws=2, scanned=1),
    Options(draws=2, directions=1, scanned=0),
    Options(components=4, draws=2, directions=1, scanned=0),
    Options(components=0, draws=0, directions=1, eps=EPS[::2], scanned=0),
)
"""Scopes of a check, from the full check to the smallest, which is for slow simulators."""
PANELS = (7, 12)
"""Numbers of panels, of 4 Gauss-Legendre points each, of the two integrals of the gradient along a line."""
LEAST_MISSED = 0.002
"""Largest error of the integral of the gradient, as a share of the cost's change, that is always accepted."""
LINE_EFFORTS = ((PLACES, HALVINGS), (3, 10), (1, 10))
"""Places searched on a line and halvings of each, from the full search to the smallest."""
FEWEST_POINTS = 17
"""Fewest points of a line scan."""
HELD = 20_000_000
"""Most numbers in the thetas of the pairs of one sigma, since memory stores several copies."""
OTHER_NOISE = 2
"""Number of further draws of the simulator's own noise under which the gradient is checked along random directions."""


def examine(
    cost: Callable[..., Any],
    theta: Any,
    grad: str | Callable[..., Any] | None = None,
    sigma: float | Sequence[float] = (),
    noise: int = 0,
    budget: float | str = 60.0,
    batch: str | None = None,
    scale: Any = None,
    seed: int = 0,
    name: str = "",
    progress: bool = True,
) -> Report:
    """Report whether a gradient is right, where the cost breaks, which method to use under noise, and its cost.

    ``cost(theta)`` returns one number. ``theta`` is an array, a number, or nested dicts, lists and dataclasses of
    arrays and numbers. ``grad`` is ``"jax"``, ``"torch"`` or a function of theta. Without ``grad``, only the cost is
    examined, by differences. ``sigma`` is one or more standard deviations of noise on theta. With ``noise=n`` the call
    is ``cost(theta, w)``, where ``w (n,)`` is standard normal, the simulator's own randomness. Costs that are compared
    have the same w. ``budget`` is the time limit of the whole examination in seconds or as text (``60``, ``"2m"``). A
    call that exceeds it is interrupted, compiled code as soon as it returns. ``batch`` is the way to pass several
    thetas in one call: ``vmap``, ``columns`` (``(d, B)``), ``rows`` (``(B, d)``) or ``loop``; detected by default.
    ``scale`` is the size of each input, with theta's structure. By default it is the input's magnitude, or for an input
    of 0 the root mean square of its array, else 1.

    Raises :class:`bench.UserError` for a cost that cannot be called.

    >>> report = examine(lambda x: x[0] ** 2 + 3 * x[1], [1.0, 2.0], grad=lambda x: [2 * x[0], 3.0], progress=False)
    >>> report.status, report.cause
    (0, 'smooth')
    """
    clock = Clock(parse_duration(budget), progress)
    levels = _levels(sigma)
    if not isinstance(noise, int | np.integer) or noise < 0:
        raise UserError(f"noise={noise} is not the length of w in cost(theta, w): give a whole number")
    layout = ParameterTree(theta)
    scales = layout.scales() if scale is None else _scales(layout, scale)
    clock.start_stage("first call")
    try:
        simulator = Simulator(cost, layout, grad, int(noise), batch, clock)
    except OutOfTime:
        took = f"the first call of the cost took longer than budget={clock.budget:g} seconds"
        raise UserError(f"{took}: give a larger budget or a shorter rollout") from None
    try:
        return _Examination(simulator, layout, scales, levels, clock, seed, name or _function_name(cost)).run(
            _function_name(grad)
        )
    finally:
        clock.clear_progress()


def _levels(sigma: float | Sequence[float]) -> list[float]:
    try:
        levels = [float(one) for one in np.atleast_1d(np.asarray(sigma, dtype=np.float64)).ravel()]
    except (TypeError, ValueError):
        levels = [math.nan]
    if not all(one > 0 and math.isfinite(one) for one in levels):
        raise UserError(f"sigma={sigma} is not valid: sigma has standard deviations of noise on theta, numbers above 0")
    return levels


def _scales(layout: ParameterTree, scale: Any) -> np.ndarray:
    given = (
        np.full(layout.vector.size, float(scale)) if isinstance(scale, int | float) else layout.flatten(scale, "scale")
    ).astype(np.float64)
    if not (np.isfinite(given).all() and (given > 0).all()):
        raise UserError("scale is the size of each input: numbers above 0")
    return given


def _function_name(function: Any) -> str:
    """Return the name of a function, such as ``mysim.cost``, or of the library that differentiates."""
    if function is None or isinstance(function, str):
        return function or ""
    module = getattr(function, "__module__", "") or ""
    name = (
        getattr(function, "__qualname__", type(function).__name__)
        .replace("<locals>.", "")
        .replace("<lambda>", "lambda")
    )
    module = GENERATED_SUFFIX.sub("", module)
    return name if module in ("__main__", "builtins", "") else f"{module}.{name}"


class _Examination:
    def __init__(
        self,
        simulator: Simulator,
        layout: ParameterTree,
        scale: np.ndarray,
        levels: Sequence[float],
        clock: Clock,
        seed: int,
        name: str,
    ) -> None:
        self.simulator, self.layout, self.scale, self.levels = simulator, layout, scale, levels
        self.clock, self.seed, self.name = clock, seed, name
        self.theta = layout.vector
        self.left_out: list[str] = []
        self.random = np.random.default_rng([seed, 0x6578616D])
        self.w = self.random.standard_normal((simulator.noise, 1)) if simulator.noise else None

    def run(self, gradient: str) -> Report:
        """Run the checks that the time allows, the gradient check first, and return the report."""
        value, spread = self._repeat_cost()
        simulator, clock = self.simulator, self.clock
        checked, more = None, []
        if spread == 0 and self._request_gradient():
            checked = self._check_gradient()
            more = self._check_under_other_noise(checked)
        lines = self._scan_lines(checked) if not simulator.gradient_error else []
        smoothed = self._measure_noise(checked, spread == 0) if not simulator.gradient_error else []
        notes = list(simulator.notes)
        notes += [f"the cost raised {count} times: {text}" for text, count in list(simulator.raised.items())[:3]]
        relative = not self.levels
        return Report(
            name=self.name,
            gradient=gradient,
            names=self.layout.names,
            theta=self.theta,
            cost=value,
            precision=simulator.precision,
            repeats=spread == 0,
            spread=spread,
            batch=simulator.batch,
            costs=clock.costs,
            gradients=clock.gradients,
            seconds=clock.spent,
            budget=clock.budget,
            cost_s=clock.per_cost(),
            gradient_s=clock.per_gradient() if simulator.has_gradient else math.nan,
            check=checked,
            more=more,
            lines=lines,
            reach=max(self.levels, default=RELATIVE),
            relative=relative,
            smoothed=smoothed,
            error=simulator.gradient_error,
            notes=notes,
            left_out=self.left_out,
        )

    # ------------------------------------------------------------------------------------------------ parts

    def _costs(self, thetas: np.ndarray, w: np.ndarray | None = None) -> np.ndarray:
        """Return the costs ``(B,)`` of ``thetas (d, B)``, all under the same draw of the simulator's own noise."""
        w = self.w if w is None else w
        return self.simulator.costs(thetas, None if w is None else np.repeat(w, thetas.shape[1], axis=1))

    def _repeat_cost(self) -> tuple[float, float]:
        """Return the cost at theta, and the largest difference between equal calls.

        Calls at theta alternate with calls at another theta, which exposes a cost that depends on earlier calls.
        """
        self.clock.start_stage("repeating a call")
        other = self.theta + 1e-3 * self.scale
        values: list[float] = []
        try:
            for at in (self.theta, other, self.theta, other, self.theta):
                values.append(float(self._costs(at[:, None])[0]))
        except OutOfTime:
            self.left_out.append("repeating a call")
        if not values:
            return math.nan, 0.0
        same = np.array(values[::2])
        pairs = [same, np.array(values[1::2] or [0.0])]
        return values[0], max(0.0 if np.isnan(one).all() else float(np.ptp(one)) for one in pairs)

    def _request_gradient(self) -> bool:
        """Compute the gradient twice, the second time to measure its duration, and return whether it succeeded."""
        if self.simulator.has_gradient:
            self.clock.start_stage("first gradient")
            try:
                for _ in range(2):
                    self.simulator.gradients(self.theta[:, None], self.w)
            except OutOfTime:
                return True
        return not self.simulator.gradient_error

    def _seconds_each(self) -> float:
        """Return the time per cost [s], in batches as wide as those of a check."""
        width = self.simulator.width
        if width == 1:
            return self.clock.per_cost()
        columns = np.repeat(self.theta[:, None], width, axis=1)
        taken = math.nan
        try:
            for _ in range(2):  # the first call with this shape may compile
                began = self.clock.spent
                self._costs(columns)
                taken = (self.clock.spent - began) / width
        except OutOfTime:
            return self.clock.per_cost()
        return taken

    def _options(self) -> Options:
        """Return the largest scope of a check that fits the remaining time."""
        each, slope = self._seconds_each(), self.clock.per_gradient()
        each = 0.0 if math.isnan(each) else each
        slope = 4 * each if math.isnan(slope) else slope
        for effort in EFFORTS[:-1]:
            chosen = min(effort.components, self.theta.size) + effort.directions
            calls = chosen * POINTS_EACH + effort.draws * effort.directions * POINTS_EACH // 2
            # a wrong gradient needs further calls: scans, ratios at other thetas, and checks at thetas farther away
            calls += effort.scanned * SCAN + effort.draws * POINTS_EACH
            calls += min(effort.draws, 4) * min(effort.components, self.theta.size) * POINTS_EACH // 2
            if calls * each + (3 * effort.draws + 3) * slope < SHARES["check"] * self.clock.remaining:
                break
        else:
            effort = EFFORTS[-1]
        if effort is not EFFORTS[0]:
            what = f"{effort.components} components, {effort.directions} directions and {effort.draws} other thetas"
            self.left_out.append(f"the full check: it is limited to {what}")
        return replace(effort, scale=self.scale, unit=self.simulator.unit, seed=self.seed)

    def _check_gradient(self) -> Check | None:
        self.clock.start_stage("checking the gradient")
        options = self._options()
        for attempt in (options, replace(options, components=0, draws=0, directions=1, eps=EPS[::2], scanned=0)):
            self.clock.limit(SHARES["check"] if attempt is options else 1.0)
            try:
                return self._check_once(attempt)
            except OutOfTime:
                continue
            finally:
                self.clock.limit(1.0)
        self.left_out.append("the gradient check")
        return None

    def _check_once(self, options: Options, w: np.ndarray | None = None) -> Check:
        def gradient(theta: np.ndarray) -> np.ndarray:
            drawn = self.w if w is None else w
            return np.asarray(self.simulator.gradients(theta[:, None], drawn)[:, 0])

        slope = gradient if self.simulator.has_gradient else None
        return check(lambda thetas: self._costs(thetas, w), slope, self.theta, options)

    def _check_under_other_noise(self, checked: Check | None) -> list[Check]:
        """Return checks along random directions under other draws of the simulator's own noise."""
        if self.w is None or checked is None or not checked.trusted:
            return []
        checks = []
        options = replace(EFFORTS[0], components=0, draws=0, scale=self.scale, unit=self.simulator.unit, seed=self.seed)
        self.clock.limit(SHARES["again"])
        try:
            for _ in range(OTHER_NOISE):
                checks.append(self._check_once(options, self.random.standard_normal((self.simulator.noise, 1))))
        except OutOfTime:
            self.left_out.append("checks under other noise")
        self.clock.limit(1.0)
        return checks

    def _scan_lines(self, checked: Check | None) -> list[LineScan]:
        """Return scans of the cost for jumps and kinks, along random directions through theta."""
        self.clock.start_stage("scanning lines")
        spread = self.scale * RELATIVE if not self.levels else np.full(self.theta.size, max(self.levels))
        along = directions(2, spread, self.seed)
        each = self.clock.per_cost()
        room = SHARES["lines"] * self.clock.remaining / len(along) / each if each > 0 else math.inf
        for most, halvings in LINE_EFFORTS:
            points = int(min(POINTS, room - 2 * most * halvings))
            if points >= FEWEST_POINTS:
                break
        else:
            self.left_out.append("jumps and kinks on lines")
            return []
        if points < POINTS:
            self.left_out.append(f"fine line scans: {points} points instead of {POINTS}, and {most} places searched")
        lines = []
        measured = checked.noise if checked is not None and math.isfinite(checked.noise) else 0.0
        self.clock.limit(2 * SHARES["lines"])
        try:
            for direction in along:
                size = float(np.abs(self._costs(self.theta[:, None])).max())
                rounding = max(measured, self.simulator.unit * (size if math.isfinite(size) else 0.0))
                line = scan(self._costs, self.theta, direction, rounding, 3.0, points, halvings, most)
                lines.append(replace(line, missed=self._missed_share(line, checked)))
        except OutOfTime:
            self.left_out.append("jumps and kinks on lines")
        self.clock.limit(1.0)
        return lines

    def _missed_share(self, line: LineScan, checked: Check | None) -> float:
        """Return the share of the cost's change along a line that its gradient does not explain.

        Without jumps, the integral of a right gradient along a line is the difference of the costs at its ends. The
        share is NaN without a right gradient, or where the integral is less accurate than both a tenth of the share and
        :data:`LEAST_MISSED`.
        """
        if checked is None or not checked.trusted or not self.simulator.has_gradient:
            return math.nan
        changes = np.abs(np.diff(line.costs)).sum()
        if not (np.isfinite(changes) and changes > 0):
            return math.nan
        integrals = []
        for panels in PANELS:
            x, weight = np.polynomial.legendre.leggauss(4)
            edges = np.linspace(line.at[0], line.at[-1], panels + 1)
            half = np.diff(edges)[:, None] / 2
            t, weights = ((edges[:-1, None] + half) + half * x).ravel(), (half * weight).ravel()
            at = self.theta[:, None] + line.direction[:, None] * t
            w = None if self.w is None else np.repeat(self.w, t.size, axis=1)
            integrals.append(float(weights @ (line.direction @ self.simulator.gradients(at, w))))
        missed = abs(line.costs[-1] - line.costs[0] - integrals[-1]) / changes
        doubt = abs(integrals[-1] - integrals[0]) / changes
        return float(missed) if doubt < max(0.1 * missed, LEAST_MISSED) else math.nan

    def _measure_noise(self, checked: Check | None, repeats: bool) -> list[Smoothed]:
        """Return the gradient's bias and the methods' costs at each sigma, which all get an equal share of the time."""
        levels, scale = list(self.levels), np.ones(self.theta.size)
        if not levels and self.simulator.noise:
            levels, scale = [RELATIVE], self.scale
        plain = None
        if checked is not None and checked.trusted and repeats and not self.simulator.noise:
            plain = checked.gradient if self.simulator.has_gradient else None
        results = []
        for index, level in enumerate(levels):
            self.clock.start_stage(f"noise of sigma {level:g}")
            self.clock.limit(1.0 / (len(levels) - index))
            pairs = min(PAIRS, max(FEWEST, HELD // self.theta.size))
            one = measure_smoothed(self.simulator, self.theta, level, scale, plain, self.clock, self.seed, pairs)
            self.clock.limit(1.0)
            if one is None:
                self.left_out.append(f"noise of sigma {level:g}")
            else:
                results.append(one)
        return results
