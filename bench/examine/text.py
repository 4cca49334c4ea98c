"""Writes a report as text: two answers with their facts, what was checked, what to do next, and tables."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bench.examine.findings import FAILED, RIGHT, SEEN, WRONG, Findings
from bench.examine.lines import REACH
from bench.examine.smoothing import PAIRS, TARGET_ERROR
from bench.examine.stages import is_rough
from bench.examine.subspace import GROUPS, MOST
from bench.gradient import FAULTS, Check, Part, step_sizes
from bench.gradient.rules import RULES, SUSPICIOUS, UNEQUAL
from bench.report.text import counted, duration, number, span

SAME_FACTOR = 0.05
"""Largest relative range of ratios that are stated as one factor."""
OVERFLOWS = 1e100
"""Size of a derivative from which on one that is not a number is an overflow."""
CHAOS = "as in chaos: the last digits of theta change the cost as much as a wide step"
HEADLINE = 200
"""Most characters of an exception in a headline."""
MANY = 6
"""Most names in a list."""


# ------------------------------------------------------------------------------------------------------- answers


def problems(report: Findings) -> list[str]:
    """Return the problems, each a cause with its meaning and facts, worst first; empty if there are none."""
    if report.derivative not in FAILED:
        return noise_problems(report)
    cause = report.derivative_cause
    found = [_sentence(cause, derivative_facts(report))]
    if cause == "nondeterministic":  # it does not hide another fault
        found += [
            _sentence(one.cause, check_facts(report, one)) for one in report.wrong_checks[:1] if one.cause in UNEQUAL
        ]
    return found


def noise_problems(report: Findings) -> list[str]:
    """Return the problems around theta or under noise, the one that decides first."""
    found = []
    for cause, one in report.noise_found:
        fact = missed_text(report) if report.missed and cause in ("staircase", "jumps") else ""
        if cause == "nan_gradient":
            fact = f"at {counted(sum(line.n_lost for line in report.lines), 'point')} of lines through theta"
        if one is not None:
            bias = f"a bias of {span(*one.bias_percent)}%" if one.known else one.remark or "not distinguishable from 0"
            fact = (
                one.remark
                if one.n_lost
                else f"grad J at sigma {sigma_text(report, one.sigma)} after {one.pairs} pairs: {bias}"
            )
        found.append(_sentence(cause, [fact, _why_biased(report) if cause == "biased" else ""]))
    return found


def _why_biased(report: Findings) -> str:
    if report.derivative_cause in (*UNEQUAL, "overwritten", "stale_gradient"):
        return "the gradient is wrong at theta already"
    return "" if report.derivative in FAILED else "as at a jump, which no gradient sees"


def sigma_text(report: Findings, level: float) -> str:
    """Return a sigma as a number, or as the smallest and largest one where it differs by input."""
    return span(*report.setup.spread(level))


def _sentence(cause: str, facts: Sequence[str]) -> str:
    known = "; ".join(filter(None, facts))
    return f"{cause}: {RULES[cause].meaning}" + f" ({known})" * bool(known)


def conclusion(report: Findings) -> str:
    """Return the answer about the derivative in one line."""
    if report.derivative in FAILED:
        return f"Derivative: {report.derivative.upper()}. {problems(report)[0]}"
    facts = [agreement(report) if report.derivative == RIGHT else "by differences the cost has one here"]
    if report.derivative_cause == "estimator":
        facts = mean_facts(report)
    facts += ["at few steps"] if report.is_quick else []
    facts += [] if report.check.draws else ["at this theta only"]
    small = [part for part in report.small_errors if part.component is not None] or report.small_errors
    off = max((part.distance for part in small), default=0.0)
    within = " within the tolerance" * bool(small) + f", off by up to {number(100 * off)}%" * (0.0 < off < math.inf)
    return f"Derivative: {report.derivative}{within}. {_sentence(report.derivative_cause, facts)}"


def noise_answer(report: Findings) -> str:
    """Return the answer about the gradient under noise in one line; without a gradient what smoothing gives, if measured."""
    if not report.gradient:
        return _noise_of_costs(report)
    levels = report.setup.sigmas
    if levels and report.noise_cause not in ("", "unmeasured"):
        # a problem is said of the sigmas that show it; lines show that of the largest
        levels = [one.sigma for cause, one in report.noise_found if one and cause == report.noise_cause] or [
            report.setup.reach
        ]
    sigmas = ", ".join(sigma_text(report, one) for one in levels)
    where = f"Under noise of sigma {sigmas}" if sigmas else "Around theta" if report.noise_cause else "Under noise"
    if report.noise_cause not in ("", "unmeasured"):
        usable = [sigma_text(report, one.sigma) for one in report.smoothed if one.is_usable]
        usable = [] if report.noise_cause == "nan_gradient" else usable
        reason = noise_problems(report)[0] + f"; usable at sigma {', '.join(usable)}" * bool(usable)
    elif report.use == "usable":
        known = [one for one in report.smoothed if one.known]
        seen = max([one.bias_percent[1] for one in known], default=0.0)
        missed = max([100 * one.unseen / one.norm for one in known], default=0.0)
        reason = f"The bias of the mean gradient is below {number(max(seen, missed, 1e-3))}%"
        if missed > 100 * TARGET_ERROR:  # more draws would lower the bound
            reason += f", and below {number(max(seen, 1e-3))}% as far as these draws show"
        reason += "" if report.derivative == RIGHT else f", though the derivative at theta is {report.derivative}"
    elif report.smoothed and not report.noise_cause and report.use != "not measured":
        is_known = all(one.known for one in report.smoothed)
        reason = "a gradient there is not a number" if is_known else "no draw moves the cost"
    elif not sigmas:
        reason = "no sigma is given"
    else:
        reason = "the gradient raised an exception" if report.error else "the budget ended"
    return f"{where}: {report.use}. {reason}"


def _noise_of_costs(report: Findings) -> str:
    """Return what noise does to a cost without a gradient: grad J by smoothing at each sigma, and the jumps within it."""
    if not report.setup.levels or not report.smoothed:
        return ""
    facts = []
    for one in report.smoothed:
        size = (
            f"|grad J| = {number(one.norm, 3)} +- {number(one.error, 1)}" if one.known else "not distinguishable from 0"
        )
        samples = [number(m.samples, 2) for m in one.methods if m.name == "smoothing" and math.isfinite(m.samples)]
        facts.append(
            f"sigma {sigma_text(report, one.sigma)}: {size}" + "".join(f", {n} samples for 10%" for n in samples)
        )
    jumps = [jump.size for line in report.lines for jump in line.jumps]
    facts += [f"{counted(len(jumps), 'jump')} of up to {number(max(jumps))} within {REACH:g} sigma"] if jumps else []
    return f"Under noise, by smoothing: {'; '.join(facts)}"


def agreement(report: Findings) -> str:
    """Return how far a right gradient agrees with the differences."""
    parts = report.resolved_parts
    text = n_checked(report)
    if not parts:
        return text
    within = max(max(part.error, part.uncertainty / abs(part.difference)) for part in parts)
    return f"{text}, {len(parts)} of them agree with differences to {number(100 * within, 1)}%"


def n_checked(report: Findings) -> str:
    """Return how many components were checked, ``2 of 3 components``."""
    return f"{len(report.check.components)} of {counted(report.theta.size, 'component')}"


# --------------------------------------------------------------------------------------------------------- facts


def derivative_facts(report: Findings) -> list[str]:
    """Return the numbers behind the cause of a derivative that is wrong or not shown."""
    repeats, explained, cause = report.repeats, report.explained, report.derivative_cause
    own = {
        "raised": [shortened(report.error)],
        "nondeterministic": [
            "the cost depends on the call before it" if repeats.has_state else "",
            "equal calls raise an exception or return a number" if repeats.is_failing else "",
            f"costs differ by {relative(report, repeats.spread)}" if repeats.spread else "",
            f"gradients differ by {number(100 * repeats.of_gradient)}%" if repeats.of_gradient else "",
        ],
        "no_effect": report.zeros[:MANY],
        "constant": [],
        "unresolved": [size_of(report, part) for part in report.unresolved[:1]],
        "rough": [_noise_text(report)],
        "biased": mean_facts(report),
        "spread": mean_facts(report),
        "unmeasured": [],
    }
    if cause == "nan_gradient" and report.means is not None and report.means.n_lost:
        return mean_facts(report)
    if cause == "nonfinite" and (place := _where_cost_fails(report)):
        return [place]
    if cause in own:
        return own[cause]
    if not report.wrong_checks:
        if report.derivative != WRONG:
            return [n_checked(report)]
        worst = max(explained.growth, key=lambda one: one.error)
        return [f"after {worst.steps} steps off by {number(100 * worst.error)}%"]
    facts = check_facts(report, report.wrong_checks[0])
    if cause == "undecided":
        facts.append("so little that adaptive steps may explain it")
    if cause == "adaptive" and explained.steps:
        facts.append(f"the loop at {explained.steps} has another length at other thetas")
    if explained.gaps and cause == "adaptive":
        here = explained.gaps[0]
        facts.append(f"from the refined cost {number(100 * here.gradient / (here.size or math.nan))}%")
    return facts


def mean_facts(report: Findings) -> list[str]:
    """Return by how much the mean of a gradient over draws is off."""
    means = report.means
    if means is None:
        return []
    if means.n_lost:
        return [f"at {means.n_lost} of {means.draws} draws"]
    if means.is_decisive:
        off = span(100 * max(means.error - means.doubt, 0.0), 100 * (means.error + means.doubt))
        return [f"its mean over {means.draws} draws is off by {off}%"]
    return [
        f"its mean is off by {span(*one.bias_percent)}%, at sigma {sigma_text(report, one.sigma)} after {one.pairs} pairs"
        for one in report.smoothed
        if one.known
    ]


def _where_cost_fails(report: Findings) -> str:
    if not math.isfinite(report.cost):
        return f"the cost at theta itself is {as_text(report.cost)}"
    if not report.failures:
        return ""
    inputs = [report.label(part) for part in report.check.components]
    _, name, at = next((place for place in report.failures if place[1] in inputs), report.failures[0])
    return f"nearest at {name} {'+' if at > 0 else '-'} {number(abs(at))}"


def check_facts(report: Findings, check: Check) -> list[str]:
    """Return the numbers of a failed check: its worst part, and what all parts have in common."""
    parts = named_parts(report, check)
    if not parts:
        return [_where_not_a_number(report, check)] if check.cause == "nan_gradient" else []
    worst = check.worst_of(parts)
    if check.cause == "kink":
        given = f", the gradient is {number(worst.program, 4)}" if report.gradient else ""
        return [f"{report.label(worst)}: slopes {number(worst.left, 4)} and {number(worst.right, 4)}{given}"]
    if check.cause in ("coarse", "unsettled") and report.explained.smooth_parts:
        known = worst.uncertainty / max(abs(worst.difference), abs(worst.program))
        return [
            size_of(report, worst),
            f"and {len(parts) - 1} more" * (len(parts) > 1),
            f"known to {number(100 * known, 2)}%",
        ]
    if check.cause not in FAULTS or not report.gradient:
        return [report.label(worst), CHAOS * (check.cause == "unsettled" and is_rough(worst.sample))]
    facts = [size_of(report, worst), f"and {len(parts) - 1} more" if len(parts) > 1 else ""]
    if check.cause == "nan_gradient":
        return [*facts, _where_not_a_number(report, check)]
    wrong = [part for part in check.components if part.verdict == check.cause]
    if check.cause in SUSPICIOUS and wrong and not any(part.sample.differences.any() for part in wrong):
        return [*facts, "the cost does not move at all"]
    return [*facts, report.hint.text if report.hint and check.cause in SUSPICIOUS else _factor(check)]


def _factor(check: Check) -> str:
    """Return by which factor a gradient is wrong, where its ratios to the differences are nearly the same."""
    wrong = [part for part in (*check.components, *check.draws) if part.verdict == check.cause]
    ratios = np.array([part.ratio for part in wrong if math.isfinite(part.ratio)])
    if check.cause not in SUSPICIOUS or ratios.size < 2:
        return ""
    middle = float(np.median(ratios))
    if np.ptp(ratios) <= SAME_FACTOR * abs(middle) and abs(middle - 1.0) > SAME_FACTOR:
        where = ", here and at other thetas" if any(part.component is None for part in wrong) else ""
        return f"{number(middle, 3)} times the derivative{where}"
    inputs = [number(part.ratio, 3) for part in wrong if part.component is not None][:4]
    return f"{', '.join(inputs)} times the derivative, by input" if check.cause == "wrong_factor" and inputs else ""


def _where_not_a_number(report: Findings, check: Check) -> str:
    """Return at which thetas or numbers of steps a gradient is not a number."""
    growth = report.explained.growth
    whole = [one.steps for one in growth if math.isfinite(one.error)]
    broken = [one.steps for one in growth if not math.isfinite(one.error)]
    if whole and broken and max(whole) < min(broken):
        return f"a number after {max(whole)} steps, and none from step {min(broken)} on"
    good = [part for part in check.draws if math.isfinite(part.program)]
    sizes = [abs(part.program) for part in (*check.parts, *check.draws) if math.isfinite(part.program)]
    if np.isinf(check.gradient).any() or max(sizes, default=0.0) > OVERFLOWS:
        return "it overflows"
    if any(is_rough(part.sample) for part in check.parts):
        return f"it overflows, {CHAOS}"
    n_bad = len(check.draws) - len(good)
    at_theta = "" if np.isfinite(check.gradient).all() else "at theta and "
    return f"{at_theta}at {n_bad} of {counted(len(check.draws), 'direction')} at other thetas" if check.draws else ""


def named_parts(report: Findings, check: Check) -> list[Part]:
    """Return the worst parts that name an input: located groups, then components, then directions."""
    located = [part for part in check.parts if part.name in report.located]
    inside = [part for part in check.worst_parts if part.component is not None]
    exact = [part for part in inside if report.label(part) in report.located.values()]
    return exact or [*located, *inside] or list(check.worst_parts)


def size_of(report: Findings, part: Part) -> str:
    """Return a part's numbers: the program's, the difference, and how far they are apart."""
    name = report.label(part)
    if part.name in report.located:
        name = f"{report.located[part.name]}, along a random direction"
    text = f"{name}: program {as_text(part.program)}, differences {as_text(part.difference)} +- {number(part.uncertainty, 1)}"
    return f"{text}, off by {number(100 * part.distance)}%" if math.isfinite(part.distance) else text


def missed_text(report: Findings) -> str:
    """Return how much of the cost's change the gradient misses, and what jumps of one height at even distances show."""
    tread = f"; jumps of one height, {number(report.tread)}, at even distances on every line" if report.tread else ""
    return (
        f"along a line the integral of the gradient misses {number(100 * report.missed)}% of the cost's change{tread}"
    )


def relative(report: Findings, spread: float) -> str:
    """Return a difference of costs, and its share of the cost."""
    size = abs(report.cost)
    share = f", {number(100 * spread / size)}% of the cost" if size > 0 and math.isfinite(size) else ""
    return f"{number(spread)}{share}"


def warnings(report: Findings) -> list[str]:
    """Return the warnings: findings that are not problems but deserve attention."""
    cause, repeats, small = report.cause, report.repeats, report.small_errors
    found = []
    if report.expect == cause and not report.is_expected:
        found.append(f"expect={cause} does not excuse a wrong gradient")
    elif report.expect:
        found.append(f"the cause is {cause}, {'as' if report.is_expected else 'not'} expected ({report.expect})")
    if small and report.derivative == RIGHT:
        found.append(
            f"small error, within the tolerance: {size_of(report, small[0])}, in {counted(len(small), 'derivative')}"
        )
    if report.check.trusted and report.derivative_cause not in ("constant", "no_effect"):
        saturated = [report.label(part) for part in report.check.components if part.verdict == "saturated"]
        is_whole = len(report.zeros) == report.theta.size and report.moves_around  # they have an effect, beside theta
        for verdict, names in (("zero", [] if is_whole else report.zeros), ("saturated", saturated)):
            found += [f"{verdict}: {', '.join(names[:MANY])}{' ...' * (len(names) > MANY)}"] if names else []
    limits = [f"precision: the cost has the digits of {report.precision}"] if report.precision != "float64" else []
    if repeats.is_small and (repeats.spread > 0 or repeats.of_gradient > 0):
        limits.append(f"equal calls differ in the last digits, costs by {relative(report, repeats.spread)}")
    found += [f"{limit}: errors below about {100 * report.resolution:.1g}% are not seen" for limit in limits]
    if report.elsewhere:
        found.append(
            f"the gradient raised an exception {report.n_failed} times away from theta: {shortened(report.elsewhere)}"
        )
    if report.derivative_cause != "nonfinite" and (place := _where_cost_fails(report)):
        found.append(f"the cost is not a number or raises an exception, {place}")
    found += [f"{name} changes theta in place: each call gets a copy" for name in report.changing]
    if report.printed:
        lines = counted(len(report.printed), "line")
        found.append(f"cost and gradient printed {lines}; the first: {shortened(report.printed[0])}")
    if not report.status and report.missed > SEEN and report.noise_cause not in ("jumps", "staircase"):
        found.append(missed_text(report))
    return [*found, *(f"not done within the budget: {what}" for what in report.left_out)]


def advice(report: Findings) -> str:
    """Return the next step, and on lines of their own the commands with the settings that take it."""
    cause, spent, explained = report.cause, report.spent, report.explained
    has_refined = bool(explained.gaps)
    given = {
        "{more}": not report.left_out and all(one.pairs >= PAIRS for one in report.smoothed),
        "sigma": not report.gradient or bool(report.setup.levels),
        "horizons": bool(explained.growth) or not report.takes_steps,
        "refined": has_refined or (cause == "undecided" and not report.wrong_checks),
        "expect": cause == "adaptive" and not has_refined,
    }
    # two costs per component or group, and the repeated calls; where no cost was timed, the first calls bound its time
    n_costs = 2 * min(report.theta.size, MOST + GROUPS) + 7
    each = spent.cost_s if math.isfinite(spent.cost_s) else spent.compile_s
    seconds = max(2 * spent.budget, 60.0, n_costs * each)
    more = f"calls={int(2 * spent.calls)}" if math.isfinite(spent.calls) else f"budget={seconds:.0f}s"
    settings = [s.format(more=more, cause=cause) for s in RULES[cause].settings if not given.get(s.partition("=")[0])]
    parts = named_parts(report, report.wrong_checks[0])[:3] if report.wrong_checks else []
    names = ", ".join(report.located.get(part.name, report.label(part)) for part in parts) or "the cost"
    prose = RULES[cause].advice.format(names=names)
    if not report.command:
        return ", or ".join(filter(None, [prose, *settings]))
    return "\n  ".join([prose or "run" * bool(settings), *(again(report, setting) for setting in settings)])


def again(report: Findings, setting: str) -> str:
    """Return the command of a report with another setting."""
    name = setting.partition("=")[0]
    return f"{re.sub(rf' {name}=[^ ]+', '', report.command)} {setting}"


# ---------------------------------------------------------------------------------------------------- the text


def as_text(value: float, digits: int = 6) -> str:
    """Return a number as text; ``NaN`` where it is not a number."""
    return "NaN" if math.isnan(value) else number(value, digits)


def shortened(text: str) -> str:
    """Return the first characters of a text on one line, for a headline."""
    line = " ".join(text.split())
    return line if len(line) <= HEADLINE else f"{line[:HEADLINE]} ..."


def write(report: Findings) -> str:
    """Return the whole report: the answers, what was checked, what to do next, and the tables."""
    rest = problems(report)[1:] if report.derivative in FAILED else []
    noise = noise_problems(report)[1 if report.gradient else 0 :]
    error = report.error or report.elsewhere
    answers = [
        conclusion(report), *(f"  {text}" for text in rest), noise_answer(report), *(f"  {text}" for text in noise),
        *(f"since the baseline: {text}" for text in report.changes), *(f"warning: {text}" for text in warnings(report)),
    ]  # fmt: skip
    scope = [f"checked: {_checked(report)}", f"not checked: {'; '.join(_unchecked(report))}"]
    scope += [f"next: {step}"] if (step := advice(report)) else []
    unit = "on theta" if report.setup.levels else "of each input's scale"
    steps = [one._asdict() for one in report.explained.growth]
    derivatives = [
        row
        for row in report.derivative_rows()
        if not row["name"].startswith("other theta ") or row["verdict"] in FAULTS
    ]
    parts = [
        list(filter(None, answers)), scope, _head(report),
        table("The derivative, by the program and by differences:", derivatives, ("left", "right", "order")),
        table("The gradient after fewer or more steps, error and uncertainty over the largest difference:", steps),
        table(f"Lines through theta, +-{REACH:g} sigma (sigma = {sigma_text(report, report.setup.reach)} {unit}):", report.line_rows()),
        table("Jumps and kinks on these lines, at t in sigma:", report.break_rows()),
        table(f"With noise of sigma {unit}, J = E cost; samples, calls and seconds are for an error of 10%:", report.sigma_rows(),
              ("remark",)),
        [f"sigma {sigma_text(report, one.sigma)}: {one.remark}" for one in report.smoothed if one.remark],
        ["The gradient's exception:", f"  {error}"] if len(error) > HEADLINE else [],
    ]  # fmt: skip
    return "\n\n".join("\n".join(part) for part in parts if part)


def _checked(report: Findings) -> str:
    facts = [n_checked(report)]
    if report.check.parts:
        whole = [part for part in report.check.parts if part.component is None]
        n_used = max(part.sample.step.size for part in report.check.parts)
        n_random = sum(part.name.startswith("direction ") for part in whole)
        counts = {
            "group": len(whole) - n_random, "random direction": n_random,
            "line": len(report.lines), "direction": len(report.check.draws),
        }  # fmt: skip
        facts.append(f"{n_used} of {max(n_used, step_sizes(report.unit).size)} step sizes")
        facts += [counted(count, what) for what, count in counts.items() if count]
        facts[-1] += " at other thetas" * bool(report.check.draws)
    return ", ".join([*facts, *(f"sigma {sigma_text(report, one.sigma)}" for one in report.smoothed)])


def _unchecked(report: Findings) -> list[str]:
    limit = "calls" if math.isfinite(report.spent.calls) and not math.isfinite(report.spent.budget) else "budget"
    rest = [f"{what} ({limit})" for what in report.left_out]
    if not report.gradient:
        rest.append("any gradient")
    elif report.smoothed:
        n_draws = 2 * min(one.pairs for one in report.smoothed)
        rest.append(f"jumps that fewer than 3 in {n_draws} draws of the noise meet")
    if report.hidden:
        rest.append(
            f"an error of one number in a group below {number(100 * report.hidden)}% of the root mean square of all"
        )
    if report.check.parts and not report.check.draws and not any("other thetas" in what for what in rest):
        rest.append(f"other thetas around this one ({limit})")
    return [*rest, "thetas far from this one"]


def _noise_text(report: Findings) -> str:
    noise = report.check.noise
    return f"cost noise {number(noise)} (standard deviation)" * (noise > 0)


def _head(report: Findings) -> list[str]:
    spent, spread = report.spent, report.repeats.spread
    point = ", ".join(f"{name}={value:g}" for name, value in zip(report.names[:MANY], report.theta[:MANY], strict=True))
    point += f", ... ({report.theta.size:,} numbers)" * (report.theta.size > MANY)
    facts = [
        report.precision, "repeats exactly" if not spread else f"equal calls differ by {number(spread)}",
        _noise_text(report), f"gradient: {report.gradient or 'none, only differences'}",
        f"batch: {report.batch}",
    ]  # fmt: skip
    waited = spent.elapsed - spent.seconds - spent.compile_s
    times = {"within the budget": spent.seconds, "first calls": spent.compile_s,
             "waiting for a processor": waited if waited > 1.0 else math.nan, "all": spent.elapsed,
             "a cost": spent.cost_s, "a gradient": spent.gradient_s}  # fmt: skip
    each = [f"{what} {duration(seconds)}" for what, seconds in times.items() if math.isfinite(seconds)]
    counts = counted(spent.costs, "cost"), counted(spent.gradients, "gradient")
    return [
        f"{report.name}: cost {report.cost:.6g} at {point}", ", ".join(filter(None, facts)),
        f"spent: {', '.join([*counts, *each])}", *(f"note: {note}" for note in report.notes),
    ]  # fmt: skip


def table(title: str, rows: Sequence[Mapping[str, Any]], without: Sequence[str] = ()) -> list[str]:
    """Return a title and rows as lines of text with aligned columns; empty without rows."""
    if not rows:
        return []
    names = [name for name in rows[0] if name not in without]
    cells = [[as_text(row[n], 5) if isinstance(row[n], float) else str(row[n]) for n in names] for row in rows]
    widths = [max(map(len, column)) for column in zip(names, *cells, strict=True)]
    return [title, *("  " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in (names, *cells))]
