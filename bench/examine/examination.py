"""Runs the examination of a cost and its gradient: cheap, decisive checks first, each kept when a later one is cut off."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial, wraps
from typing import Any

import numpy as np

from bench.errors import UserError, unknown
from bench.examine import diagnosis
from bench.examine.facts import NOISE_CAUSES
from bench.examine.findings import Spent
from bench.examine.judged import RELATIVE, GroupSize, Setup
from bench.examine.lines import HALVINGS, PLACES, POINTS, REACH, SIDES, LineScan, scan
from bench.examine.means import OF_A_DRAW, Mean, compare_means
from bench.examine.report import Report
from bench.examine.smoothing import (
    FEWEST,
    FIRM,
    OWN_PAIRS,
    PAIRS,
    Smoothed,
    directions,
    largest_unseen,
    measure_smoothed,
)
from bench.examine.stages import GradientStages
from bench.examine.subspace import Group
from bench.gradient import FAULTS
from bench.gradient.rules import RULES, SUSPICIOUS
from bench.simulator.clock import Clock, OutOfTime, parse_duration
from bench.simulator.simulator import Simulator, accepts
from bench.simulator.tree import ParameterTree

TOLERANCE = 1e-4
"""Default relative error of a derivative below which it only causes a warning."""
COMPILE_S = 300.0
"""Default time limit of all first calls together [s]."""
NODES = (28, 48)
"""Points of the two integrals of the gradient along a line, by Gauss-Legendre."""
LEAST_MISSED = 0.002
"""Largest error of the integral of the gradient, as a share of the cost's change, that is always accepted."""
LINE_EFFORTS = ((POINTS, HALVINGS, PLACES), (49, 10, 3), (17, 10, 1))
"""Points of a line, halvings of the interval of a break, and places searched, from the full search to the smallest."""
MEANS_SHARE = 0.4
"""Share of the remaining budget for the mean of a gradient over draws of the simulator's own noise."""
OWN_LEVELS, OWN_SHARE, OWN_DRAWS = (0.01, 0.03, 0.1, 0.3, 1.0), 0.6, 64
"""Sigmas of a cost with its own noise, in units of each input's scale; the first is taken that moves the cost by this share of
its own standard deviation in this number of draws."""
EARLY_SHARE = 0.5
"""Share of the remaining budget for the lines of a gradient that adaptive steps may explain."""
HELD = 20_000_000
"""Most numbers in the thetas of the pairs of one sigma, since memory stores several copies."""
KEY, WORDS_OF_A_KEY = "key", 2
"""Noise that is a key of JAX, and its number of words."""
MOST_NOISY = 50_000
"""Most numbers of theta for which noise is measured."""


def examine(
    cost: Callable[..., Any],
    theta: Any,
    grad: str | Callable[..., Any] | None = None,
    sigma: Any = (),
    noise: int | str = 0,
    budget: float | str | None = None,
    batch: str | int | None = None,
    scale: Any = None,
    seed: int = 0,
    name: str = "",
    progress: bool = True,
    *,
    calls: int | None = None,
    compile_budget: float | str = COMPILE_S,
    tolerance: Any = TOLERANCE,
    atol: Any = 0.0,
    allow_zero: bool | str | Sequence[str] | None = None,
    expect: str = "",
    refined: Callable[..., Any] | None = None,
    horizons: Sequence[int] = (),
) -> Report:
    """Report whether a gradient is right, where the cost breaks, which method to use under noise, and its cost.

    ``cost(theta)`` returns one number. ``theta`` is an array, a number, or nested dicts, lists and dataclasses of
    arrays and numbers. ``grad`` is ``"jax"``, ``"torch"`` or a function of theta. Without ``grad``, only the cost is
    examined, by differences. ``sigma`` is one or more standard deviations of noise on theta: numbers, or per input a
    mapping such as ``{"mass": 0.1}``, theta's structure, or an array ``(levels, d)``. With ``noise=n`` the call is
    ``cost(theta, w)``, where ``w (n,)`` is standard normal, the simulator's own randomness, with ``noise="key"``
    ``cost(theta, key)`` with a key of ``jax.random``. Costs that are compared have the same w or key.

    ``budget`` is the time limit of the whole examination in seconds or as text (``60``, ``"2m"``), 60 s by default.
    ``calls`` limits the number of costs and gradients together; without ``budget`` it makes the report independent of the machine.
    The first call of each kind may compile and counts against ``compile_budget`` instead. A call that exceeds its limit
    is interrupted, compiled code as soon as it returns. ``batch`` is the way to pass several thetas in one call:
    ``vmap``, ``columns`` (``(d, B)``), ``rows`` (``(B, d)``) or ``loop``, with a fixed B as ``columns:64``; detected by
    default. ``scale`` is the size of each input, with theta's structure. By default it is the input's magnitude, or for
    an input of 0 the root mean square of its array, else 1.

    An error up to ``atol + tolerance * |derivative|`` only causes a warning; both are numbers or mappings of inputs to
    numbers. ``allow_zero`` names the inputs that may have no effect (True: all; False: none; by default they cause a
    warning). ``expect`` is a known cause, such as ``"kink"``, with which the report passes; a wrong gradient never does.

    ``refined`` is the cost at a tighter tolerance or finer step. ``horizons`` are numbers of steps T at which
    ``cost(theta, steps=T)`` and its gradient are compared, which shows an error that grows with T.

    Raises :class:`bench.UserError` for a cost that cannot be called.

    >>> report = examine(lambda x: x[0] ** 2 + 3 * x[1], [1.0, 2.0], grad=lambda x: [2 * x[0], 3.0], progress=False)
    >>> report.status, report.cause
    (0, 'smooth')
    """
    if calls is not None and not (isinstance(calls, int | np.integer) and calls > 0):
        raise UserError(f"calls={calls} is not a number of calls: give a whole number above 0")
    clock = Clock(
        math.inf if budget is None and calls is not None else parse_duration(60.0 if budget is None else budget),
        progress,
        math.inf if calls is None else float(calls),
        parse_duration(compile_budget, "compile_budget"),
    )
    if not (refined is None or callable(refined)):
        raise UserError(f"refined is a function of theta, not {type(refined).__name__}")
    if str(noise) == KEY:
        noise, (cost, grad, refined) = WORDS_OF_A_KEY, map(_with_key, (cost, grad, refined))
    if not isinstance(noise, int | np.integer) or noise < 0:
        raise UserError(f"noise={noise} is not the length of w in cost(theta, w): give a whole number, or {KEY}")
    if not all(steps > 0 and float(steps).is_integer() for steps in horizons):
        raise UserError(f"horizons={','.join(map(str, horizons))} are not numbers of steps: give whole numbers above 0")
    layout = ParameterTree(theta)
    with np.errstate(over="ignore"):
        scales = layout.scales()
    setup = Setup(
        levels=_levels(sigma, layout),
        scale=scales if scale is None else _by_input(layout, scale, "scale", 1.0, is_positive=True),
        rtol=_by_input(layout, tolerance, "tolerance", TOLERANCE),
        atol=_by_input(layout, atol, "atol", 0.0),
        allow_zero=_allowed(layout, allow_zero),
        seed=seed,
        horizons=tuple(map(int, horizons)),
    )
    expectable = [name for name, rule in RULES.items() if rule.kind in ("open", "broken") or name in NOISE_CAUSES]
    if expect in FAULTS and expect not in expectable:
        raise UserError(f"expect={expect}: a wrong gradient cannot be expected")
    if expect and expect not in expectable:
        raise unknown("expect", expect, expectable)
    named = {
        "name": name or _function_name(cost),
        "gradient": _function_name(grad),
        "expect": expect,
        "takes_steps": all(
            accepts(function, theta, *[0] * bool(noise), steps=1) for function in (cost, grad) if callable(function)
        ),
    }
    cost, grad, refined = map(_with_own_warnings, (cost, grad, refined))
    # a cost of huge or infinite numbers overflows in the differences too, where a warning would tell nothing
    with np.errstate(all="ignore"):
        try:
            simulator = Simulator(cost, layout, grad, int(noise), batch, clock)
        except OutOfTime:
            took = f"the first call of the cost took longer than compile_budget={clock.compile_budget:g} seconds"
            raise UserError(f"{took}: give a larger compile_budget or a shorter rollout") from None
        examination = _Examination(simulator, setup)
        try:
            return examination.run(named, refined)
        finally:
            clock.clear_progress()


def _levels(sigma: Any, layout: ParameterTree) -> list[tuple[float, np.ndarray]]:
    try:
        rows = [sigma] if isinstance(sigma, Mapping | str) else np.atleast_1d([] if sigma is None else sigma)
    except ValueError:
        raise UserError(f"sigma={sigma} is not valid: give a number, or a list of numbers") from None
    every = [layout.spread(one, "sigma", 0.0) for one in rows]
    if not all(np.isfinite(one).all() and (one >= 0).all() and one.any() for one in every):
        raise UserError(f"sigma={sigma} is not valid: sigma has standard deviations of noise on theta, numbers above 0")
    return [(float(one.max()), one) for one in every]


def _by_input(layout: ParameterTree, given: Any, what: str, default: float, is_positive: bool = False) -> np.ndarray:
    """Return a number per input ``(d,)``; raises :class:`UserError` for numbers below 0, or for 0 where ``is_positive``."""
    values = layout.spread(given, what, default)
    if not (np.isfinite(values).all() and (values >= 0).all() and (values.all() or not is_positive)):
        least = "above" if is_positive else "of at least"
        raise UserError(f"{what}={given} is not valid: give a number {least} 0, or one per input")
    return values


def _allowed(layout: ParameterTree, given: bool | str | Sequence[str] | None) -> np.ndarray | None:
    if given is None:
        return None
    allowed = np.full(layout.vector.size, given is True)
    for name in [] if isinstance(given, bool) else [given] if isinstance(given, str) else given:
        allowed[layout.match(name)] = True
    return allowed


def _with_own_warnings(function: Any) -> Any:
    """Return a user's function that warns of its own arithmetic as it does outside of an examination."""
    if not callable(function):
        return function
    own = np.geterr()

    @wraps(function, updated=())
    def call(*arguments: Any, **settings: Any) -> Any:
        with np.errstate(**own):
            return function(*arguments, **settings)

    return call


def _with_key(function: Any) -> Any:
    """Return a function of theta and a key of JAX as one of theta and the normal numbers whose bits are the key."""
    if not callable(function):
        return function

    @wraps(function)
    def keyed(theta: Any, w: Any, **settings: Any) -> Any:
        import jax

        words = jax.lax.bitcast_convert_type(jax.numpy.asarray(w, dtype="float32"), "uint32")
        return function(theta, jax.random.wrap_key_data(words), **settings)

    return keyed


def _function_name(function: Any) -> str:
    """Return the name of a function, without brackets, or of the library that differentiates."""
    if function is None or isinstance(function, str):
        return function or ""
    return re.sub(r"<locals>\.|[<>]", "", getattr(function, "__qualname__", type(function).__name__))


class _Examination:
    def __init__(self, simulator: Simulator, setup: Setup) -> None:
        self.simulator, self.setup, self.clock = simulator, setup, simulator.clock
        self.explained = diagnosis.Explanation()
        self.means: Mean | None = None
        self._near: list[LineScan] | None = None
        """Lines at theta that do not depend on sigma."""
        self.stages = GradientStages(simulator, setup.scale, setup.seed, bool(setup.levels))
        self.left_out = self.stages.left_out

    def run(self, named: Mapping[str, Any], refined: Any) -> Report:
        """Run the checks that the budget allows, the decisive ones first, and return the report."""
        simulator, clock, stages, setup, explained = self.simulator, self.clock, self.stages, self.setup, self.explained
        stages.run(self._compare_early)
        gradient = stages.gradient
        has_gradient = gradient is not None
        is_wrong = has_gradient and stages.check.cause in SUSPICIOUS
        self._find_smooth_parts()
        if refined is not None and (is_wrong or explained.wide):
            self._explain("refined", "the refined cost", diagnosis.refined_slopes, refined)
        if setup.horizons:
            self._explain("growth", "horizons", diagnosis.errors_by_horizon, setup.horizons)
        if is_wrong:
            self._explain("difference_step", "steps of a difference", diagnosis.step_of_difference)
            self._explain("gradient_noise", "noise of the gradient", diagnosis.noise_of_gradient)
        self._compare_means()
        can_go_on = has_gradient or not simulator.has_gradient
        if is_wrong and explained.is_adaptive is None:
            explained.is_adaptive = self._compare_along_lines(0.9)
        lines = self._scan_lines() if can_go_on else []
        smoothed = self._measure_noise(lines) if can_go_on else []
        stages.repeat_failures()
        return Report(
            **named,
            layout=simulator.layout,
            cost=stages.value,
            precision=simulator.precision,
            batch=simulator.mode,
            repeats=stages.repeats,
            setup=setup,
            spent=Spent(
                clock.counts["costs"],
                clock.counts["gradients"],
                clock.spent,
                clock.compile_s,
                clock.seconds_per("costs"),
                clock.seconds_per("gradients"),
                clock.budget,
                clock.calls,
            ),
            check=stages.check,
            is_complete=stages.is_complete,
            located=stages.located,
            groups={k: self._size_of(v, gradient) for k, v in stages.groups.items() if gradient is not None},
            more=stages.more,
            explained=explained,
            is_random=simulator.noise > 0,
            means=self.means,
            lines=lines,
            smoothed=smoothed,
            error=next(iter(simulator.raised["gradients"]), ""),
            is_failed=stages.is_failed,
            n_failed=simulator.raised["gradients"].total(),
            printed=simulator.printed.getvalue().splitlines(),
            notes=[
                *simulator.notes,
                *(f"the cost raised {n} times: {text}" for text, n in simulator.raised["costs"].most_common(3)),
            ],
            left_out=self.left_out,
            enough=self._enough(),
        )

    def _enough(self) -> tuple[float, float]:
        """Return the numbers of costs and gradients with which nothing is left out, as far as is known."""
        n_sigmas, (costs, gradients) = len(self.setup.levels) or bool(self.simulator.noise), self.stages.enough()
        lines = len(directions(2, self.setup.scale, 0))
        costs += 2 * lines * (POINTS + PLACES * (2 * HALVINGS + 2 * SIDES)) + n_sigmas * 2 * FIRM
        return costs, gradients + (lines * sum(NODES) + n_sigmas * 2 * FIRM) * self.simulator.has_gradient

    def _size_of(self, group: Group, gradient: np.ndarray) -> GroupSize:
        """Return what errors of a group's numbers do to the slope along its direction."""
        part, setup = slice(group.first, group.last), self.setup
        slope = np.abs(gradient[part])
        per_input = setup.tolerated(part, slope), slope
        return GroupSize(slope.size, *(float(np.linalg.norm(setup.scale[part] * each)) for each in per_input))

    def _attempt(self, what: str, function: Callable[[], Any], share: float = 1.0) -> Any:
        """Return a function's result within a share of the remaining budget, or None where that ends."""
        with self.clock.stage(what, self.left_out, share):
            return function()
        return None

    def _explain(self, name: str, what: str, function: Callable[..., Any], *given: Any) -> None:
        """Set a comparison of :attr:`explained`, unless the budget ends before."""
        found = self._attempt(what, partial(function, self.stages, *given))
        if found is not None:
            setattr(self.explained, name, found)

    # ------------------------------------------------------------------------------------------------ lines

    def _compare_early(self) -> None:
        """Keep the smooth part of a rough cost, and whether adaptive steps explain the small error of a gradient."""
        self._compare_means()
        self._find_smooth_parts()
        if diagnosis.may_be_adaptive(self.stages.check):
            self.explained.is_adaptive = self._compare_along_lines(EARLY_SHARE)

    def _compare_means(self) -> None:
        """Compare the mean over draws of a gradient that is not the derivative at one of them."""
        is_of_a_draw = any(one.cause in OF_A_DRAW for one in (self.stages.check, *self.stages.more))
        if self.means is None and self.simulator.noise and is_of_a_draw and self.stages.gradient is not None:
            self.means = self._attempt("the mean over draws", lambda: compare_means(self.stages), MEANS_SHARE)

    def _find_smooth_parts(self) -> None:
        if self.stages.gradient is not None and not self.explained.wide:
            self._explain("smooth_parts", "the smooth part of the cost", diagnosis.smooth_parts)

    def _compare_along_lines(self, share: float) -> bool | None:
        """Return whether the program's steps depend on theta and its jumps explain the gradient's error.

        None where the budget ends before. Nothing here depends on sigma.
        """
        if self.explained.steps is None:
            self._explain("steps", "the loops of the program", diagnosis.changing_steps)
        if not self.explained.steps:
            return None if self.explained.steps is None else False
        near = self._scan_near(share)
        effort = self._effort(0.9)
        decide = partial(diagnosis.is_adaptive, self.stages, near, effort)
        return self._attempt("the comparison along lines", decide) if near and effort[0] else None

    def _effort(self, share: float) -> tuple[int, int, int]:
        """Return the largest of :data:`LINE_EFFORTS` that fits a share of the remaining budget; zeros where none does."""
        for effort in LINE_EFFORTS:
            points, halvings, most = effort
            if self.clock.can_afford(points + most * (2 * halvings + 2 * SIDES), share=share):
                return effort
        return 0, 0, 0

    def _scan_lines(self) -> list[LineScan]:
        """Return scans of the cost over the noise, or near theta without sigma."""
        if not self.setup.levels:
            return self._scan_near(0.9)
        return self._scan(max(self.setup.levels, key=lambda level: level[0])[1], 0.5)

    def _scan_near(self, share: float) -> list[LineScan]:
        if self._near is None:
            self._near = self._scan(self.setup.scale * RELATIVE, share)
        return self._near

    def _scan(self, spread: np.ndarray, share: float) -> list[LineScan]:
        """Return scans of the cost for jumps and kinks, along random directions through theta.

        They take at most ``share`` of the remaining budget.
        """
        along, unit, lines = directions(2, spread, self.setup.seed), self.simulator.unit, list[LineScan]()
        effort = self._effort(share / len(along))
        sizes = [self.stages.check.noise, self.stages.repeats.spread, unit * abs(self.stages.value)]
        rounding = float(np.nan_to_num(sizes, posinf=0.0).max())
        with self.clock.stage("jumps and kinks on lines", self.left_out, min(1.0, 2 * share)):
            if not effort[0]:
                raise OutOfTime
            for direction in along:
                cost = partial(self.stages.costs_along, direction)
                lines.append(self._integrated(scan(cost, direction, rounding, REACH, effort, unit)))
        if 0 < effort[0] < POINTS:
            self.left_out.append(
                f"fine line scans: {effort[0]} points instead of {POINTS}, {effort[2]} places searched"
            )
        return lines

    def _integrated(self, line: LineScan) -> LineScan:
        """Return a line with the share of the cost's change that a right gradient does not explain.

        Without jumps, the integral of a right gradient along a line, by Gauss-Legendre, is the difference of the costs at
        its ends. The share is NaN without a right gradient, or where the integral is less accurate than both a tenth of
        the share and :data:`LEAST_MISSED`. Points at which the gradient is not a number, and the cost is, are counted instead.
        """
        if not self.stages.check.trusted or not self.simulator.has_gradient:
            return line
        changes = np.abs(np.diff(line.costs)).sum()
        rounding = self.simulator.unit * np.abs(line.costs).max(initial=0.0) + self.stages.check.noise
        # where the cost hardly changes, its rounding is all that the integral could miss
        if not (np.isfinite(changes) and changes > 0 and rounding < 0.1 * LEAST_MISSED * changes):
            return line
        if not self.clock.can_afford(0, sum(NODES)):
            self.left_out.append("the integral of the gradient along a line")
            return line
        integrals, half = [], float(line.at[-1])
        for points in NODES:
            x, weights = np.polynomial.legendre.leggauss(points)
            slopes = self.stages.along(lambda at: line.direction @ self.stages.gradients(at), line.direction, half * x)
            lost = half * x[~np.isfinite(slopes)]
            if lost.size and np.isfinite(self.stages.costs_along(line.direction, lost)).any():
                return replace(line, n_lost=lost.size)
            integrals.append(half * float(weights @ slopes))
        missed = abs(line.costs[-1] - line.costs[0] - integrals[-1]) / changes
        doubt = abs(integrals[-1] - integrals[0]) / changes
        return replace(line, missed=float(missed)) if doubt < max(0.1 * missed, LEAST_MISSED) else line

    # ------------------------------------------------------------------------------------------------ noise

    def _measure_noise(self, lines: Sequence[LineScan]) -> list[Smoothed]:
        """Return the gradient's bias and the methods' costs at each sigma, which all get an equal share of the budget."""
        levels, size = list(self.setup.levels), self.stages.theta.size
        if not levels and self.simulator.noise:
            levels = self._attempt("the size of the cost's own noise", self._own_level) or []
        if levels and size > MOST_NOISY:
            self.left_out.append(f"noise on theta: it has more than {MOST_NOISY:,} numbers")
            return []
        plain = self.stages.gradient if self.stages.check.trusted and not self.simulator.noise else None
        results = []
        pairs = min(OWN_PAIRS if self.simulator.noise else PAIRS, max(FEWEST, HELD // size))
        for index, (level, spread) in enumerate(levels):
            unseen = partial(largest_unseen, lines, level / self.setup.reach) if self.setup.levels else None
            measure = partial(measure_smoothed, self.simulator, level, spread, plain, self.setup.seed, pairs, unseen)
            results.append(self._attempt(f"noise of sigma {level:g}", measure, 1.0 / (len(levels) - index)))
        return [one for one in results if one]

    def _own_level(self) -> list[tuple[float, np.ndarray]]:
        """Return a sigma under which theta moves the cost by a share of what its own noise does."""
        random = np.random.default_rng([self.setup.seed, 0x6F776E])
        w, u = (random.standard_normal((n, OWN_DRAWS)) for n in (self.simulator.noise, self.stages.theta.size))
        theta, scale, level = self.stages.theta[:, None], self.setup.scale[:, None], OWN_LEVELS[-1]
        own = float(self.simulator.costs(np.repeat(theta, OWN_DRAWS, axis=1), w).std())
        for level in OWN_LEVELS:
            up, down = (self.simulator.costs(theta + sign * level * scale * u, w) for sign in (1.0, -1.0))
            if np.sqrt(np.mean(((up - down) / 2.0) ** 2)) >= OWN_SHARE * own:
                break
        return [(level, level * self.setup.scale)]
