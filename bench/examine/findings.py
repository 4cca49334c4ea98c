"""The findings of an examination: the verdicts that follow from its facts, and their tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.errors import needing_sweeps
from bench.examine.diagnosis import may_be_adaptive
from bench.examine.facts import CONTRADICTED, DIGIT, NOISE_CAUSES, SEEN, Facts
from bench.examine.smoothing import TARGET_ERROR, Method, Smoothed
from bench.examine.subspace import MOST
from bench.examine.verdicts import in_order
from bench.gradient import FAULTS, TRUSTED, Part, rules
from bench.gradient.direction import CHANCE, resolution
from bench.gradient.rules import RULES, STATUS, UNEQUAL
from bench.report.text import counted, number, span

if TYPE_CHECKING:
    import pandas as pd

SHOWN = 8
"""Most numbers of theta in the table of breaks."""
RIGHT, WRONG, UNSHOWN, BROKEN, NONE = "right", "wrong", "not shown", "undefined", "none given"
"""Answers about the derivative. ``undefined``: the cost has a jump or a kink at theta."""
FAILED = (WRONG, UNSHOWN, BROKEN)
"""Answers that decide before noise does."""


@dataclass(frozen=True)
class Spent:
    """What an examination took, and its limits."""

    costs: int
    """Number of costs computed, one per theta."""
    gradients: int
    """Number of gradients computed, one per theta."""
    seconds: float
    """Time within the budget [s]."""
    compile_s: float
    """Time of first calls [s]."""
    cost_s: float
    """Time of one cost [s]."""
    gradient_s: float
    """Time of one gradient [s]; NaN without a gradient."""
    budget: float
    calls: float
    """Limit of costs and gradients together."""


@dataclass(frozen=True)
class Findings(Facts):
    """The facts about a cost and its gradient at one theta, the verdicts that follow from them, and what a report says besides."""

    name: str
    """Name of the cost."""
    batch: str
    spent: Spent
    n_failed: int
    """Number of gradient calls that raised an exception."""
    printed: Sequence[str]
    """The lines that cost and gradient printed."""
    notes: Sequence[str]
    left_out: Sequence[str]
    """The parts of the examination that the budget did not allow."""
    enough: tuple[float, float]
    """Costs and gradients with which nothing is left out."""
    expect: str = ""
    """The known cause with which the report passes."""
    command: str = ""
    """The command line of this report, or empty."""
    changes: Sequence[str] = ()
    """Differences from the baseline."""
    is_as_before: bool = False
    """Whether there is a baseline and nothing is worse."""
    takes_steps: bool = False
    """Whether cost and gradient take ``steps``, a number of steps."""

    # ------------------------------------------------------------------------------------------ the derivative

    @cached_property
    def _verdict(self) -> tuple[str, str]:
        return next((cause, fact) for cause, holds, fact in in_order(self) if holds)

    @property
    def derivative_cause(self) -> str:
        """The cause of the first problem with the derivative at theta, or the verdict on a right one."""
        return self._verdict[0]

    @property
    def fact(self) -> str:
        """The numbers behind :attr:`derivative_cause`."""
        return self._verdict[1]

    @property
    def derivative(self) -> str:
        """The answer about the derivative at theta: one of ``right``, ``wrong``, ``not shown``, ``undefined``, ``none given``."""
        if self.derivative_cause in rules.BROKEN:
            return BROKEN
        kind = RULES[self.derivative_cause].kind
        return {"open": UNSHOWN, "right": RIGHT if self.gradient else NONE}.get(kind, WRONG)

    @property
    def suspects(self) -> list[str]:
        """The inputs of :attr:`culprits`, by names that a user has: of one number of a large array the array's."""
        names: list[str] = []
        for part in self.culprits:
            index = part.component
            first, last = self.located.get(part.name, (0, 0) if index is None else (index, index + 1))
            leaves = self.layout.inside(first, last)
            is_entry = last - first == 1 and (first in self._located_numbers or leaves[0].size <= MOST)
            names += [self.layout.name(first)] if is_entry else [leaf.name for leaf in leaves]
        return list(dict.fromkeys(names))

    @property
    def can_refine(self) -> bool:
        """Whether a refined cost can show that the error is one of the discretisation."""
        explained = self.explained
        return bool(explained.wide or explained.steps) or may_be_adaptive(self.check)

    @property
    def small_errors(self) -> list[Part]:
        """The parts with an error within the tolerance, the largest first."""
        if self.check.cause not in UNEQUAL:
            return []
        return sorted(filter(self._is_small, self.check.parts), key=lambda part: -part.error)

    @property
    def resolution(self) -> float:
        """The smallest relative error that these differences detect."""
        errors = [CHANCE * p.uncertainty / abs(p.difference) for p in self.resolved_parts]
        return max([resolution(self.unit), *errors])

    @property
    def hidden(self) -> float:
        """Relative error of one typical number that the check of its group may not show; 0 without groups."""
        errors = [
            self.groups[part.name].hidden(max(part.apart, CONTRADICTED * part.uncertainty + part.sample.doubt))
            for part in self.check.parts
            if part.name in self.groups and (part.verdict in TRUSTED or self._is_small(part))
        ]
        return max((error for error in errors if math.isfinite(error)), default=0.0)

    # ---------------------------------------------------------------------------------------------- under noise

    @cached_property
    def noise_found(self) -> list[tuple[str, Smoothed | None, str]]:
        """The problems around theta or under noise, each with the sigma that shows it and its facts; the first one decides."""
        is_mean = self.derivative_cause == "estimator"  # not the derivative of the draw whose lines were scanned
        is_stairs, n_lost = self.has_steps and self.derivative in (RIGHT, NONE), sum(line.n_lost for line in self.lines)
        has_jumps = any(line.jumps for line in self.lines if line.missed > SEEN)
        kind = "staircase" if is_stairs or self.tread else "jumps" if has_jumps else "spread"
        found: list[tuple[str, Smoothed | None, str]] = []
        if not is_mean and (is_stairs or self.misses_jumps):
            found.append((kind, None, self.missed_text))
        if n_lost:
            found.append(("nan_gradient", None, f"at {counted(n_lost, 'point')} of lines through theta"))
        for one in self.smoothed:
            is_shown = one.cause == "spread" and is_mean and not self.setup.levels  # by draws at theta itself
            bias = f"a bias of {span(*one.bias_percent)}%" if one.known else one.remark or "not distinguishable from 0"
            fact = f"grad J at sigma {self.setup.shown(one.sigma)} after {one.pairs} pairs: {bias}"
            found += [(one.cause, one, one.remark if one.n_lost else fact)] if one.cause and not is_shown else []
        if self.gradient and len(self.smoothed) < len(self.setup.sigmas):
            found.append(("unmeasured", None, ""))
        return sorted(found, key=lambda each: NOISE_CAUSES.index(each[0]))

    @property
    def missed_text(self) -> str:
        """How much of the cost's change the gradient misses, and what jumps of one height at even distances show."""
        tread = f"; jumps of one height, {number(self.tread)}, at even distances on every line" if self.tread else ""
        count = max((len(line.jumps) for line in self.lines if line.missed == self.missed), default=0)
        jumps = f" with {counted(count, 'jump')}" * bool(count)
        missed = f"along a line{jumps} the integral of the gradient misses {number(100 * self.missed)}% of the change"
        return missed * bool(self.missed) + tread

    @property
    def noise_cause(self) -> str:
        """The cause of the first problem around theta or under noise, from costs and gradients there; empty if there is none."""
        return self.noise_found[0][0] if self.noise_found else ""

    @property
    def _has_biases(self) -> bool:
        """Whether the bias of the mean gradient is known at the measured sigmas."""
        return bool(self.smoothed) and all(math.isfinite(one.bias) and one.known for one in self.smoothed)

    @property
    def missed(self) -> float:
        """Largest share of the cost's change along a line that the integral of the gradient misses; 0 if unknown."""
        return max((line.missed for line in self.lines if math.isfinite(line.missed)), default=0.0)

    @property
    def misses_jumps(self) -> bool:
        """Whether a line shows jumps that bias the gradient, and no measured bias says more."""
        # a part of the cost that is rounded everywhere is a fault of its own, however small
        if self.tread:
            is_measured = self._has_biases and len(self.smoothed) >= len(self.setup.sigmas)
            return self.missed > SEEN and not (is_measured and all(one.decided for one in self.smoothed))
        return self.missed > TARGET_ERROR and not self._has_biases

    @property
    def use(self) -> str:
        """The answer about the gradient under noise: ``usable``, ``NOT usable``, ``not shown`` or ``not measured``."""
        if self.noise_cause not in ("", "unmeasured"):
            return "not shown" if RULES[self.noise_cause].kind == "open" else "NOT usable"
        if self.noise_cause or not self.smoothed or any(one.cause for one in self.smoothed):
            return "not measured"
        return "usable" if self._has_biases else "not shown"

    def recommended(self, one: Smoothed) -> Method | None:
        """Return the fastest usable method at a sigma; None if none is known."""
        best = one.best
        if one.cause in ("spread", "nonfinite"):
            return None
        if best is not None and best.name != "smoothing" and self.derivative == WRONG:
            return next((m for m in one.methods if m.name == "smoothing" and math.isfinite(m.seconds)), None)
        return best

    # ----------------------------------------------------------------------------------------------------- both

    @property
    def cause(self) -> str:
        """The cause of the first problem, that of theta before noise, or the verdict on a right gradient: a key of ``RULES``."""
        if self.derivative in FAILED:
            return self.derivative_cause
        return self.noise_cause or self.derivative_cause

    @property
    def status(self) -> int:
        """The exit status: 0 right, 1 wrong, 3 not decided; 0 also for the expected cause, and as in the baseline."""
        if self.is_as_before or self.is_expected:
            return 0
        return STATUS[RULES[self.cause].kind]

    @property
    def is_expected(self) -> bool:
        """Whether the cause is the expected one, and no wrong gradient."""
        is_open = RULES[self.cause].kind in ("open", "broken") or self.derivative in (RIGHT, NONE)
        is_open &= not (self.cause == "unresolved" and self.wrong_checks)
        is_known = self.resolved_parts and self.repeats.of_gradient <= DIGIT
        is_open &= self.cause != "noisy" or bool(is_known)
        # with sigma, the bias that jumps on a line make is measured and has a cause of its own
        is_of_jumps = self.cause == "biased" and self.missed > TARGET_ERROR
        return self.expect in (self.cause, "jumps" if is_of_jumps else self.cause) and is_open

    @property
    def size(self) -> float:
        """Largest relative error of a checked derivative, NaN if unknown."""
        if not self.gradient:
            return math.nan
        parts = [part for part in self.check.worst_parts if part.component is not None] or list(self.check.worst_parts)
        parts = parts if self.check.cause in FAULTS else list(self.check.components)
        return max((part.error for part in parts if math.isfinite(part.error)), default=math.nan)

    # --------------------------------------------------------------------------------------------------- tables

    @property
    def _shown(self) -> range:
        return range(min(self.theta.size, SHOWN))

    def derivative_rows(self) -> list[dict[str, Any]]:
        """Return a row per checked derivative: the program's value, the difference, and the verdict."""
        names = ("program", "difference", "uncertainty", "step", "ratio", "left", "right", "order", "verdict")
        parts = *self.named.parts, *self.named.draws
        of_program = {} if self.gradient else dict.fromkeys(("program", "ratio", "order"), math.nan)
        return [{"name": self.label(p)} | {name: getattr(p, name) for name in names} | of_program for p in parts]

    def sigma_rows(self) -> list[dict[str, Any]]:
        """Return a row per sigma and method: the bias, and the cost of a relative error of 10%."""
        rows = []
        for one in self.smoothed:
            best = self.recommended(one)
            names = ("sigma", "norm", "pairs", "bias", "bias_low", "bias_high", "error", "moved", "remark")
            base = {"norm_se" if name == "error" else name: getattr(one, name) for name in names}
            for method in one.methods or (Method("", *[math.nan] * 4),):
                each = {name: getattr(method, name) for name in ("samples", "calls", "seconds")}
                rows.append(base | {"method": method.name} | each | {"best": method is best})
        return rows

    def line_rows(self) -> list[dict[str, Any]]:
        """Return a row per line through theta: its jumps and kinks, and the share of the change that the gradient misses."""
        return [
            {
                "line": index + 1,
                "jumps": len(line.jumps),
                "kinks": len(line.breaks) - len(line.jumps),
                "share missed by the gradient": line.missed if math.isfinite(line.missed) else "unknown",
                "staircase": line.steps,
                "not finite": int((~np.isfinite(line.costs)).sum()),
            }
            for index, line in enumerate(self.lines)
        ]

    def break_rows(self) -> list[dict[str, Any]]:
        """Return a row per jump or kink: line, position in standard deviations, size, and the first numbers of theta there."""
        return [
            {"line": index + 1, "kind": b.kind, "at": b.at, "size": b.size}
            | {self.layout.name(i): float((self.theta + b.at * line.direction)[i]) for i in self._shown}
            for index, line in enumerate(self.lines)
            for b in line.breaks
        ]

    @property
    def frame(self) -> pd.DataFrame:
        """The table of :meth:`derivative_rows`."""
        return _frame(self.derivative_rows())

    @property
    def sigmas(self) -> pd.DataFrame:
        """The table of :meth:`sigma_rows`."""
        return _frame(self.sigma_rows())

    @property
    def breaks(self) -> pd.DataFrame:
        """The table of :meth:`break_rows`."""
        return _frame(self.break_rows(), ["line", "kind", "at", "size", *map(self.layout.name, self._shown)])


def _frame(rows: list[dict[str, Any]], columns: list[str] | None = None) -> pd.DataFrame:
    with needing_sweeps("a table"):
        import pandas as pd

    return pd.DataFrame(rows, columns=columns)
