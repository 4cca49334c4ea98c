"""The findings of an examination: verdicts, text and tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.examine.lines import ALIKE, LineScan
from bench.examine.smoothing import TARGET_ERROR, Smoothed
from bench.measure.gradcheck import FAULTS, MEANING, Check, Part
from bench.report.text import counted, duration, number

if TYPE_CHECKING:
    import pandas as pd

EXPLANATIONS = {
    "nan_gradient": "the gradient is not a number where the cost is: a division, log, sqrt or norm at the edge of its domain, "
    "or a branch that 'where' discards only in the value",
    "nondeterministic": "the same call returns different numbers: new noise in every call, or state that persists between calls; "
    "pass the noise as w, or fix its seed",
    "stale_gradient": "the gradient does not change when theta does: a cache that is never cleared, or a copy made too early",
    "staircase": "the cost is constant between steps: a cast to int, rounding, or a comparison inside",
    "precision": "the cost has fewer digits than its type: a shorter float inside, or a solver that stops early",
    "disconnected": "the gradient is exactly 0 where the cost has a slope: detached, or an operation that cuts gradients",
    "wrong_factor": "the ratio is constant: a factor or a sign is wrong",
    "missing_term": "ratio not constant: a term is missing or detached",
    "wrong_adjoint": "the differences agree with each other, but not with the gradient",
    "nonfinite": "the cost is not a number at theta or near it",
    "unsettled": "the differences agree at no step, so the check is inconclusive: the cost is chaotic, or too noisy at every step",
    "jump": "the cost jumps at theta, so it has no derivative",
    "kink": "theta is on a kink, with two slopes and no derivative",
    "saturated": "the gradient is right and exactly 0, though wider steps show a slope: the input is clipped, or has no effect here",
    "zero": "the gradient and all differences are exactly 0: does this input have any effect?",
}
"""The meaning of each cause for the simulator's author, with likely reasons."""
SEEN = 0.01
"""Share of a cost's change along a line that the integral of the gradient may miss without a warning."""
NOTEWORTHY = ("zero", "saturated")
"""Verdicts of right gradients that deserve a warning."""


@dataclass(frozen=True)
class Findings:
    """The findings about a cost and its gradient at one theta; ``print`` shows them as text."""

    name: str
    """Name of the cost."""
    gradient: str
    """Source of the gradient: ``jax``, ``torch``, a function's name, or empty for differences only."""
    names: Sequence[str]
    """A name for each of theta's d numbers."""
    theta: np.ndarray
    """``(d,)``."""
    cost: float
    precision: str
    repeats: bool
    """Whether equal calls return equal costs."""
    spread: float
    """Largest difference between equal calls."""
    batch: str
    costs: int
    """Number of costs computed, one per theta."""
    gradients: int
    """Number of gradients computed, one per theta."""
    seconds: float
    budget: float
    cost_s: float
    """Time of one cost [s]."""
    gradient_s: float
    """Time of one gradient [s]; NaN without a gradient."""
    check: Check | None
    """The gradient check; None if it did not finish within the budget."""
    more: Sequence[Check]
    """Checks under further draws of the simulator's own noise."""
    lines: Sequence[LineScan]
    reach: float
    """One standard deviation on the lines: a sigma of theta, or a share of the scale of each input."""
    relative: bool
    """Whether sigma is relative to the scale of each input, as it is by default."""
    smoothed: Sequence[Smoothed]
    error: str
    """The exception that the gradient raised; empty if none."""
    notes: Sequence[str]
    left_out: Sequence[str]
    """The parts of the examination that the budget did not allow."""

    # -------------------------------------------------------------------------------------------- verdicts

    @property
    def cause(self) -> str:
        """The cause of the first problem, or the verdict on a right gradient.

        A cause is a verdict of the gradient check or one of these. ``raised``: the gradient could not be computed.
        ``undecided``: the budget ended before the check. ``jumps`` or ``biased``: the gradient is right at theta, but
        misses jumps around theta. ``spread``: the gradient's values around theta vary too widely to decide.
        """
        if self.error:
            return "raised"
        if not self.repeats:
            return "nondeterministic"
        if self.check is None:
            return "undecided"
        bad = [one.cause for one in (self.check, *self.more) if not one.trusted]
        if not bad and (any(line.steps for line in self.lines) or self.tread):
            return "staircase"
        if not bad and self.missed > TARGET_ERROR:
            return "jumps"
        if not bad and not all(one.defined for one in self.smoothed):
            return "nonfinite"
        if not bad and any(one.biased for one in self.smoothed):
            return "biased"
        if not bad and any(one.unshown for one in self.smoothed):
            return "spread"
        return bad[0] if bad else self.check.cause

    @property
    def problems(self) -> list[str]:
        """The problems as sentences, worst first; empty if there are none."""
        problems = []
        if self.error:
            problems.append(f"raised: the gradient could not be computed: {self.error}")
        elif not self.repeats:
            problems.append(
                f"nondeterministic: {EXPLANATIONS['nondeterministic']} (costs differ by {number(self.spread)})"
            )
        elif self.check is None:
            problems.append("undecided: the budget ended before the gradient was checked")
        else:
            problems += [self.sentence(one) for one in (self.check, *self.more) if not one.trusted][:1]
        if not problems and any(line.steps for line in self.lines):
            problems.append(
                "staircase: the cost is constant between jumps, here and on a line: its derivative is 0 and carries no "
                "information; smooth the cost, as sigma= does"
            )
        elif not problems and self.tread:
            problems.append(
                f"staircase: jumps of one height, {number(self.tread)}, at even distances on every line: a part of the cost "
                "is rounded, cast to int or looked up on a grid, and the gradient misses this part, "
                f"{number(100 * self.missed)}% of the cost's change on a line"
            )
        if not problems:
            missed = self.missed
            if missed > TARGET_ERROR:
                problems.append(
                    f"jumps: along a line the integral of the gradient misses {number(100 * missed)}% of the cost's change, "
                    "which comes from jumps that no gradient sees"
                )
            for one in self.smoothed:
                if not one.defined:
                    problems.append(f"nonfinite: at sigma {number(one.sigma)} J is not defined: {one.remark}")
                if one.unshown:
                    problems.append(
                        f"spread: at sigma {number(one.sigma)} the gradients vary so widely that {one.pairs} pairs do not show "
                        "whether their mean is grad J: use costs, as the table recommends"
                    )
                if one.biased:
                    low, high = one.bias_low / one.norm, one.bias_high / one.norm
                    problems.append(
                        f"biased: at sigma {number(one.sigma)} the mean of the gradients misses {number(100 * low)} to "
                        f"{number(100 * high)}% of grad J, though each gradient is right: it does not see the jumps"
                    )
        return problems

    @property
    def conclusion(self) -> str:
        """One-line verdict: the first problem, otherwise what was verified."""
        if self.problems:
            return f"CANNOT BE TRUSTED: {self.problems[0]}"
        how = MEANING[self.cause].removeprefix("right").lstrip(":; ")
        if self.gradient:
            return f"RIGHT: the gradient is the derivative of its cost ({self.cause}: {how})"
        return (
            f"NO GRADIENT GIVEN, none was checked: by differences the cost has a derivative here ({self.cause}: {how})"
        )

    @property
    def warnings(self) -> list[str]:
        """The warnings as sentences: findings that are not problems but deserve attention."""
        warnings = []
        if self.check is not None and self.check.trusted:
            for verdict in NOTEWORTHY:
                parts = [self.label(part) for part in self.check.components if part.verdict == verdict]
                if parts:
                    warnings.append(
                        f"{verdict}: {', '.join(parts[:6])}{' ...' if len(parts) > 6 else ''}: {EXPLANATIONS[verdict]}"
                    )
        if self.precision != "float64":
            warnings.append(
                f"{self.precision}: a check in {self.precision} detects errors above about {self.resolution}"
            )
        if not self.status and self.missed > SEEN:
            warnings.append(
                f"jumps: along a line the integral of the gradient misses {number(100 * self.missed)}% of the cost's change"
            )
        warnings += [f"not done within the budget: {what}" for what in self.left_out]
        return warnings

    @property
    def missed(self) -> float:
        """Largest share of the cost's change along a line that the integral of the gradient misses; 0 if unknown."""
        return max((line.missed for line in self.lines if math.isfinite(line.missed)), default=0.0)

    @property
    def tread(self) -> float:
        """Height of the jumps, if all lines have equal, evenly spaced jumps that the gradient misses; else 0."""
        treads = [line.tread for line in self.lines] or [0.0]
        alike = min(treads) > (1 - ALIKE) * max(treads)
        return max(treads) if alike and self.missed > SEEN else 0.0

    @property
    def resolution(self) -> str:
        """The smallest relative error that central differences detect in this precision, about u^(2/3), as text in %."""
        unit = 2.0**-7 if self.precision == "bfloat16" else float(np.finfo(self.precision).eps)
        return f"{100 * unit ** (2 / 3):.1g}%"

    @property
    def status(self) -> int:
        """The exit status: 0 without problems, else 1."""
        return 1 if self.problems else 0

    def label(self, part: Part) -> str:
        """Return a part's name: the name of its component of theta, or the name of its direction, ``direction 0``."""
        return self.names[part.component] if part.component is not None else part.name

    def sentence(self, check: Check) -> str:
        """Return the verdict of a failed check as a sentence, with the numbers of the worst part."""
        text = f"{check.cause}: {EXPLANATIONS.get(check.cause, check.cause)}"
        parts = [part for part in check.worst_parts if part.component is not None] or list(check.worst_parts)
        if not parts:
            return text
        part = max(parts, key=lambda p: np.nan_to_num(p.error, nan=math.inf))
        if check.cause == "kink":
            return f"{text} ({self.label(part)}: {number(part.left, 4)} and {number(part.right, 4)})"
        if check.cause not in FAULTS:
            return f"{text} ({self.label(part)})"
        program = "" if not self.gradient else f"program {number(part.program, 6)}, "
        return f"{text} ({self.label(part)}: {program}differences {number(part.difference, 6)})"

    # ---------------------------------------------------------------------------------------------- tables

    @property
    def frame(self) -> pd.DataFrame:
        """A row per checked derivative: the program's value, the difference, and the verdict."""
        import pandas as pd

        parts = [(self.label(part), part) for part in (*self.check.parts, *self.check.draws)] if self.check else []
        shown = bool(self.gradient)
        return pd.DataFrame(
            {
                "name": [name for name, _ in parts],
                "program": [part.program if shown else math.nan for _, part in parts],
                "difference": [part.difference for _, part in parts],
                "uncertainty": [part.uncertainty for _, part in parts],
                "step": [part.step for _, part in parts],
                "ratio": [part.ratio if shown else math.nan for _, part in parts],
                "left": [part.left for _, part in parts],
                "right": [part.right for _, part in parts],
                "order": [part.order if shown else math.nan for _, part in parts],
                "verdict": [part.verdict for _, part in parts],
            }
        )

    @property
    def sigmas(self) -> pd.DataFrame:
        """A row per sigma and method: the bias, and the cost of a relative error of 10%."""
        import pandas as pd

        rows = []
        for one in self.smoothed:
            base = dict(
                sigma=one.sigma, norm=one.norm, norm_se=one.error, pairs=one.pairs, bias=one.bias, bias_low=one.bias_low,
                bias_high=one.bias_high, moved=one.moved, remark=one.remark,
            )  # fmt: skip
            for method in one.methods:
                best = one.best is not None and one.best.name == method.name
                rows.append(
                    base
                    | dict(
                        method=method.name,
                        samples=method.samples,
                        calls=method.calls,
                        seconds=method.seconds,
                        best=best,
                    )
                )
            if not one.methods:
                rows.append(base | dict(method="", samples=math.nan, calls=math.nan, seconds=math.nan, best=False))
        return pd.DataFrame(rows)

    @property
    def breaks(self) -> pd.DataFrame:
        """A row per jump or kink: line, position in standard deviations, and size."""
        import pandas as pd

        rows = [
            dict(line=index + 1, kind=b.kind, at=b.at, size=b.size)
            for index, line in enumerate(self.lines)
            for b in line.breaks
        ]
        return pd.DataFrame(rows, columns=["line", "kind", "at", "size"])

    # ------------------------------------------------------------------------------------------------ text

    def __str__(self) -> str:
        parts = [self._head(), self._components(), self._breaks(), self._sigmas(), self._end()]
        return "\n\n".join("\n".join(part) for part in parts if part)

    def _head(self) -> list[str]:
        shown = ", ".join(f"{name}={value:g}" for name, value in list(zip(self.names, self.theta, strict=True))[:6])
        shown += f", ... ({self.theta.size} numbers)" if self.theta.size > 6 else ""
        repeats = "repeats exactly" if self.repeats else f"DOES NOT REPEAT: calls differ by {number(self.spread)}"
        if self.repeats and self.check is not None and self.check.noise > 0:
            repeats += f", rough by {number(self.check.noise)}"
        lines = [
            f"{self.name}: cost {self.cost:.6g} at {shown}",
            f"{self.precision}, {repeats}; gradient: {self.gradient or 'none, only differences'}; batch: {self.batch}",
        ]
        spent = f"spent: {counted(self.costs, 'cost')}"
        if self.gradient:
            spent += f" and {counted(self.gradients, 'gradient')}"
        spent += f" in {duration(self.seconds)} of {duration(self.budget)}; a cost takes {duration(self.cost_s)}"
        if math.isfinite(self.gradient_s):
            spent += f", a gradient {duration(self.gradient_s)}"
        return [*lines, spent, *(f"note: {note}" for note in self.notes)]

    def _components(self) -> list[str]:
        if self.check is None:
            return []
        check = self.check
        head = ["", "program", "differences", "step", "ratio", "verdict"]
        rows = [head]
        whole = [part for part in check.parts if part.component is None]
        for part in (*check.components, *whole):
            rows.append(
                [
                    self.label(part),
                    number(part.program, 6) if self.gradient else "-",
                    f"{number(part.difference, 6)} +- {number(part.uncertainty, 1)}",
                    number(part.step, 1),
                    number(part.ratio, 5) if self.gradient else "-",
                    part.verdict,
                ]
            )
        title = "Is the gradient right?" if self.gradient else "The derivative by differences:"
        lines = [title, *_table(rows)]
        if check.draws:
            wrong = [part for part in check.draws if part.verdict in FAULTS]
            lines.append(
                f"  elsewhere: {counted(len(check.draws), 'direction')} at other thetas around this one, "
                + (f"{len(wrong)} wrong: {wrong[0].verdict}" if wrong else "none wrong")
            )
        if self.gradient and math.isfinite(check.order):
            lines.append(
                f"  Taylor remainder |f(x + h d) - f(x) - h g.d|: order {check.order:.2f} in h (2 right, 1 wrong)"
            )
        return lines

    def _breaks(self) -> list[str]:
        if not self.lines:
            return []
        unit = "of each input's scale" if self.relative else "on theta"
        count = counted(len(self.lines), "line")
        lines = [f"Jumps and kinks on {count} through theta, +-3 sigma (sigma = {number(self.reach)} {unit}):"]
        for index, line in enumerate(self.lines):
            remarks = []
            for kind, breaks in (("jump", line.jumps), ("kink", line.kinks)):
                if breaks:
                    first = ", ".join(f"{b.at:+.3f} ({number(b.size)})" for b in breaks[:4])
                    size = "height" if kind == "jump" else "change of slope"
                    remarks.append(
                        f"{counted(len(breaks), kind)} at t = {first}{' ...' if len(breaks) > 4 else ''} [{size}]"
                    )
            bad = int((~np.isfinite(line.costs)).sum())
            if bad:
                remarks.append(f"{bad} of {line.costs.size} costs are not numbers")
            if math.isfinite(line.missed):
                remarks.append(
                    f"the gradient's integral explains {number(100 * (1 - line.missed), 4)}% of the cost's change"
                )
            if line.steps:
                remarks.append("constant between jumps: a staircase")
            if not line.breaks:
                remarks.insert(0, "none found")
            lines.append(f"  line {index + 1}: {'; '.join(remarks)}")
        if any(len(line.breaks) > 5 for line in self.lines):
            lines.append("  at most six places are searched on a line, so there may be more")
        return lines

    def _sigmas(self) -> list[str]:
        if not self.smoothed:
            return self._without_noise()
        unit = ", relative to each input's scale" if self.relative else ""
        rows = [["sigma", "|grad J|", "bias of the gradient", "smoothing changes it by", "use", "10% error costs"]]
        remarks = []
        for one in self.smoothed:
            rows.append(
                [
                    number(one.sigma),
                    f"{number(one.norm, 3)} +- {number(one.error, 1)}",
                    self._bias(one),
                    f"{number(100 * one.moved / one.norm)}%" if math.isfinite(one.moved) and one.known else "-",
                    *self._use(one),
                ]
            )
            if one.remark:
                remarks.append(f"  sigma {number(one.sigma)}: {one.remark}")
        return [f"With noise of sigma on theta{unit}, J = E cost:", *_table(rows), *remarks]

    def _bias(self, one: Smoothed) -> str:
        if not math.isfinite(one.bias):
            return "-"
        if not one.known:
            return "unknown"
        low, high = 100 * one.bias_low / one.norm, 100 * one.bias_high / one.norm
        if one.unshown:
            return "unknown: the gradients vary too widely"
        if low <= 0:
            return f"none seen, below {number(high)}%"
        return f"{number(100 * one.bias / one.norm)}% [{number(low)}, {number(high)}]"

    def _use(self, one: Smoothed) -> tuple[str, str]:
        best = one.best
        if best is None:
            return "unknown", "-"
        if self.problems and self.cause in (*FAULTS, "raised") and best.name == "gradient":
            best = next((m for m in one.methods if m.name == "smoothing" and math.isfinite(m.seconds)), None)
            if best is None:
                return "unknown", "-"
        kind = "gradient" if best.name == "gradient" else "cost"
        return f"{best.name}, N = {int(best.samples):,}", f"{counted(int(best.calls), kind)}, {duration(best.seconds)}"

    def _without_noise(self) -> list[str]:
        """Return the lines of the recommendation for use without noise."""
        if self.check is None or self.status:
            return []
        dim = self.theta.size
        lines = [f"Without noise: central differences take {2 * dim} costs, {duration(2 * dim * self.cost_s)}"]
        if self.gradient and math.isfinite(self.gradient_s):
            fewer = "use the gradient" if self.gradient_s < 2 * dim * self.cost_s else "differences are no slower"
            lines[0] += f"; the gradient {duration(self.gradient_s)}: {fewer}"
        return lines

    def _end(self) -> list[str]:
        lines = [f"warning: {text}" for text in self.warnings]
        if self.problems:
            return [*lines, *(f"CANNOT BE TRUSTED: {text}" for text in self.problems)]
        return [*lines, self.conclusion, *self._scope()]

    def _scope(self) -> list[str]:
        """Return lines that state what was and was not checked, for a report without problems."""
        check = self.check
        assert check is not None
        dim, seen = self.theta.size, len(check.components)
        whole = len(check.parts) - seen
        checked = f"checked: {seen} of {dim} components" if seen < dim else f"checked: {counted(dim, 'component')}"
        checked += f" and {counted(whole, 'random direction')} at theta"
        if check.draws:
            checked += f", {counted(len(check.draws), 'direction')} at other thetas around it"
        if self.lines:
            checked += f", jumps on {counted(len(self.lines), 'line')}"
        if self.smoothed:
            checked += f", noise of sigma {', '.join(number(one.sigma) for one in self.smoothed)}"
        rest = [] if self.gradient else ["any gradient"]
        rest += ["the gradient under noise on theta: give sigma"] if self.gradient and not self.smoothed else []
        rest += ["thetas far from this one"]
        return [checked, f"not checked: {'; '.join(rest)}"]


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows as lines of text with aligned columns."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
