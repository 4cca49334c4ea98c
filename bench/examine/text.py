"""Lays out a report as text: two answers with their facts, what was checked, what to do next, and tables."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bench.examine.facts import SEEN, as_text, shortened
from bench.examine.findings import FAILED, NONE, RIGHT, Findings
from bench.examine.lines import REACH
from bench.examine.smoothing import PAIRS, TARGET_ERROR
from bench.gradient import FAULTS
from bench.gradient.rules import RULES
from bench.report.text import counted, duration, number

MANY = 6
"""Most names in a list."""


# ------------------------------------------------------------------------------------------------------- answers


def problems(report: Findings) -> list[str]:
    """Return the problems, each a cause with its meaning and facts, worst first; empty if there are none."""
    if report.derivative in FAILED:
        return [_sentence(report.derivative_cause, report.fact)]
    return noise_problems(report)


def noise_problems(report: Findings) -> list[str]:
    """Return the problems around theta or under noise, the one that decides first."""
    return [_sentence(cause, fact) for cause, _, fact in report.noise_found]


def _sentence(cause: str, fact: str) -> str:
    return f"{cause}: {RULES[cause].meaning}" + f" ({fact})" * bool(fact)


def conclusion(report: Findings) -> str:
    """Return the answer about the derivative in one line."""
    if report.derivative in FAILED:
        return f"Derivative: {report.derivative.upper()}. {problems(report)[0]}"
    fact = report.n_checked + ", at this theta only" * (not report.check.draws)
    if report.derivative == RIGHT:
        parts = report.resolved_parts
        within = max((max(part.error, part.uncertainty / abs(part.difference)) for part in parts), default=0.0)
        fact += f", {len(parts)} of them to {number(100 * within, 1)}%" * bool(parts)
    small = [part for part in report.small_errors if part.component is not None] or report.small_errors
    off = f" within the tolerance, off by up to {number(100 * small[0].distance)}%" if small else ""
    fact = report.mean_text if report.derivative_cause == "estimator" else fact
    return f"Derivative: {report.derivative}{off}. {_sentence(report.derivative_cause, fact)}"


def noise_answer(report: Findings) -> str:
    """Return the answer about the gradient under noise in one line; without one, what noise meets and smoothing takes."""
    if not report.gradient:
        return _costs_under_noise(report)
    cause, setup, known = report.noise_cause, report.setup, [one for one in report.smoothed if one.known]
    is_problem, levels, fact = cause not in ("", "unmeasured"), setup.sigmas, ""
    if is_problem:
        # a problem is said of the sigmas that show it; lines show that of the largest
        shown = [one.sigma for each, one, _ in report.noise_found if one and each == cause] or [setup.reach]
        levels = shown if levels else []
        usable = [setup.shown(one.sigma) for one in report.smoothed if one.is_usable and cause != "nan_gradient"]
        fact = f". {noise_problems(report)[0]}" + f"; usable at sigma {', '.join(usable)}" * bool(usable)
    elif report.use == "usable":
        bounds = [(one.bias_percent[1], 100 * one.unseen / one.norm) for one in known]
        bias, unseen = np.max(bounds, axis=0, initial=0.0).tolist()
        fact = f" to {100 * TARGET_ERROR:.0f}%" * (report.derivative_cause == "biased")
        fact += f". The bias of the mean gradient is below {number(bias)}%"
        fact += f", and an event that no draw met may add {number(unseen)}%"
    where = (
        f"Under noise of sigma {', '.join(map(setup.shown, levels))}"
        if levels
        else "Around theta"
        if is_problem
        else "Under noise"
    )
    return f"{where}: {report.use}{fact}"


def _costs_under_noise(report: Findings) -> str:
    """Return the number of jumps within the noise, and the calls that smoothing needs; empty without a sigma."""
    setup, jumps = report.setup, sum(len(line.jumps) for line in report.lines)
    if not setup.levels:
        return ""
    found = [f"{counted(jumps, 'jump')} within {REACH:g} sigma on {counted(len(report.lines), 'line')}"] * bool(
        report.lines
    )
    best = {one.sigma: report.recommended(one) for one in report.smoothed}
    found += [
        f"smoothing has an error of 10% after {method.calls:.0f} calls at sigma {setup.shown(sigma)}"
        for sigma, method in best.items()
        if method
    ] or ["what smoothing needs is not known"]
    return f"Under noise of sigma {', '.join(map(setup.shown, setup.sigmas))}: {', '.join(found)}"


def warnings(report: Findings) -> list[str]:
    """Return the warnings: findings that are not problems but deserve attention."""
    cause, repeats, small = report.cause, report.repeats, report.small_errors
    is_whole = len(report.zeros) == report.theta.size and report.moves_around  # they have an effect, beside theta
    zeros = report.zeros if report.check.trusted and report.derivative_cause != "no_effect" and not is_whole else []
    last = f"equal calls differ in the last digits, {report.spread_text}"
    limits = {
        f"precision: the cost has the digits of {report.precision}": report.precision != "float64",
        last: not repeats.is_failing and not repeats.is_large and (repeats.spread > 0 or repeats.of_gradient > 0),
    }
    answer = "holds" if report.is_expected else "does not excuse a wrong gradient" * (report.expect == cause)
    found = {
        f"expect={report.expect} {answer or f'does not hold: the cause is {cause}'}": report.expect,
        f"small error, within the tolerance: {''.join(map(report.numbers, small[:1]))}": small
        and report.derivative == RIGHT,
        f"zero: {', '.join(zeros[:MANY])}{' ...' * (len(zeros) > MANY)}": zeros
        and report.derivative_cause != "constant",
        **{
            f"{limit}: errors below about {number(100 * report.resolution, 1)}% are not seen": holds
            for limit, holds in limits.items()
        },
        f"the gradient raised an exception {report.n_failed} times away from theta: {report.error_text}": report.n_failed
        and not report.is_failed,
        f"the cost is not a number or raises an exception, {report.place}": report.derivative_cause != "nonfinite"
        and report.place,
        f"cost and gradient printed {counted(len(report.printed), 'line')}; the first: {shortened(''.join(report.printed[:1]))}": report.printed,
        report.missed_text: not report.status
        and report.missed > SEEN
        and report.noise_cause not in ("jumps", "staircase"),
        **{f"not done within the budget: {what}": True for what in report.left_out},
    }
    return [text for text, holds in found.items() if holds]


def advice(report: Findings) -> str:
    """Return the next step, and on lines of their own the commands with the settings that take it."""
    cause, explained = report.cause, report.explained
    has_refined = explained.refined is not None
    given = {
        "{more}": not report.left_out and all(one.pairs >= PAIRS for one in report.smoothed),
        "sigma": not report.gradient or bool(report.setup.levels),
        "horizons": bool(explained.growth) or not report.takes_steps,
        "refined": has_refined or not report.can_refine,
        "expect": cause == "adaptive" and not has_refined,
    }
    wanted = RULES[cause].settings
    wanted = (*wanted, "{more}") if report.left_out and report.derivative in (RIGHT, NONE) else wanted
    settings = [
        s.format(more=_more(report), cause=cause) for s in dict.fromkeys(wanted) if not given.get(s.partition("=")[0])
    ]
    prose = RULES[cause].advice.format(names=", ".join(report.suspects[:3]) or "theta")
    if not report.command:
        return ", or ".join(filter(None, [prose, *settings]))
    return "\n  ".join([prose or "run" * bool(settings), *(again(report, setting) for setting in settings)])


def _more(report: Findings) -> str:
    """Return the setting of a budget with which nothing is left out, at least twice the given one."""
    spent, (costs, gradients) = report.spent, report.enough
    if math.isfinite(spent.calls):
        return f"calls={rounded_up(max(2 * spent.calls, costs + gradients))}"
    # where no cost was timed, the first calls bound its time
    each = spent.cost_s if math.isfinite(spent.cost_s) else spent.compile_s
    slope = spent.gradient_s if math.isfinite(spent.gradient_s) else 4 * each
    return f"budget={rounded_up(max(2 * spent.budget, 60.0, costs * each + gradients * slope))}s"


def rounded_up(value: float) -> int:
    """Return the next whole number of at most two digits and zeros."""
    unit = 10 ** max(len(str(math.ceil(value))) - 2, 0)
    return math.ceil(value / unit) * unit


def again(report: Findings, setting: str) -> str:
    """Return the command of a report with another setting."""
    name = setting.partition("=")[0]
    return f"{re.sub(rf' {name}=[^ ]+', '', report.command)} {setting}"


# ---------------------------------------------------------------------------------------------------- the text


def write(report: Findings) -> str:
    """Return the whole report: the answers, what was checked, what to do next, and the tables."""
    noise = noise_problems(report)[1 if report.gradient else 0 :]
    error, step = report.error, advice(report)
    unit = "on theta" if report.setup.levels else "of each input's scale"
    derivatives = [
        row
        for row in report.derivative_rows()
        if not row["name"].startswith("other theta ") or row["verdict"] in FAULTS
    ]
    parts = [
        [
            conclusion(report),
            noise_answer(report),
            *(f"  {text}" for text in noise),
            *(f"since the baseline: {text}" for text in report.changes),
            *(f"warning: {text}" for text in warnings(report)),
        ],
        [f"checked: {_checked(report)}", f"not checked: {'; '.join(_unchecked(report))}", f"next: {step}" * bool(step)],
        _head(report),
        table("The derivative, by the program and by differences:", derivatives),
        table(
            "The gradient after fewer or more steps, error and uncertainty over the largest difference, norm in units of the scales:",
            [one._asdict() for one in report.explained.growth],
        ),
        table(
            f"Lines through theta, +-{REACH:g} sigma (sigma = {report.setup.shown(report.setup.reach)} {unit}):",
            report.line_rows(),
        ),
        table("Jumps and kinks on these lines, at t in sigma:", report.break_rows()),
        table(
            f"With noise of sigma {unit}, J = E cost; samples, calls and seconds are for an error of 10%:",
            report.sigma_rows(),
        ),
        ["The gradient's exception:", f"  {error}"] if len(error) > len(report.error_text) else [],
    ]
    return "\n\n".join("\n".join(filter(None, part)) for part in parts if part)


def _checked(report: Findings) -> str:
    sigmas = [f"sigma {report.setup.shown(one.sigma)}" for one in report.smoothed]
    others = counted(len(report.check.draws), "direction") + " at other thetas"
    return ", ".join([report.n_checked, others, counted(len(report.lines), "line"), *sigmas])


def _unchecked(report: Findings) -> list[str]:
    limit = "calls" if math.isfinite(report.spent.calls) and not math.isfinite(report.spent.budget) else "budget"
    n_draws = 2 * min((one.pairs for one in report.smoothed), default=0)
    has_rest = (
        report.check.parts and not report.check.draws and not any("other thetas" in what for what in report.left_out)
    )
    rest = {
        **{f"{what} ({limit})": True for what in report.left_out},
        "any gradient": not report.gradient,
        f"jumps that fewer than 3 in {n_draws} draws of the noise meet": report.gradient and n_draws,
        f"an error of one number in a group below {number(100 * report.hidden)}% of the root mean square of all": report.hidden,
        f"other thetas around this one ({limit})": has_rest,
        "thetas far from this one": True,
    }
    return [what for what, holds in rest.items() if holds]


def _head(report: Findings) -> list[str]:
    spent, noise = report.spent, report.check.noise
    point = ", ".join(f"{report.layout.name(i)}={value:g}" for i, value in enumerate(report.theta[:MANY]))
    point += f", ... ({report.theta.size:,} numbers)" * (report.theta.size > MANY)
    spread = f"equal calls differ by {number(report.repeats.spread)}" if report.repeats.spread else "repeats exactly"
    gradient = report.gradient or "none, only differences"
    times = {
        "within the budget": spent.seconds,
        "first calls": spent.compile_s,
        "a cost": spent.cost_s,
        "a gradient": spent.gradient_s,
    }
    each = [f"{what} {duration(seconds)}" for what, seconds in times.items() if math.isfinite(seconds)]
    counts = counted(spent.costs, "cost"), counted(spent.gradients, "gradient")
    return [
        f"{report.name}: cost {report.cost:.6g} at {point}",
        f"{report.precision}, {spread}, cost noise {number(noise)}, gradient: {gradient}, batch: {report.batch}",
        f"spent: {', '.join([*counts, *each])}",
        *(f"note: {note}" for note in report.notes),
    ]


def table(title: str, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a title and rows as lines of text with aligned columns, without columns of NaN and ""; empty without rows."""
    names = [name for name in (rows[0] if rows else ()) if any(row[name] == row[name] != "" for row in rows)]
    cells = [[as_text(row[n], 5) if isinstance(row[n], float) else str(row[n]) for n in names] for row in rows]
    widths = [max(map(len, column)) for column in zip(names, *cells, strict=True)]
    return [title, *("  " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in (names, *cells))] if rows else []
