"""Describes a trace in sentences."""

from __future__ import annotations

import numpy as np
import pandas as pd

from bench.report.text import counted
from bench.trace.spikes import LEVEL, MEASURES, SPIKE, Alignment, align, changes, spikes

LISTED = 5
"""Most switches and spikes that a sentence lists."""


def report(table: pd.DataFrame, gradient_error: float) -> list[str]:
    """Return sentences on contact, on the range of the gradient measures, and on spikes at contact switches."""
    return [
        _contact_summary(table),
        *_switch_list(table),
        _gradient_summary(table, gradient_error),
        *verdict(table),
    ]


def verdict(table: pd.DataFrame) -> list[str]:
    """Return whether gradient spikes line up with contact switches: one sentence, or one for each measure."""
    largest = {name: float(np.exp(changes(table[name]).max())) for name in MEASURES}
    change = " and ".join(f"{MEASURES[name]} by at most {three_digits(factor)}x" for name, factor in largest.items())
    if not table["contacts"].any():
        force = three_digits(table["force"].max())
        afar = f" (forces of up to {force} N act from a distance)" if table["force"].max() > 0 else ""
        return [f"No contact in this rollout{afar}, so no switch for a spike to line up with; per step, {change}."]
    switches = int(table["switch"].sum())
    if not switches:
        return [f"Contact never switches in this rollout, so no spike can line up with it; per step, {change}."]
    return [
        _sentence(
            MEASURES[name], align(table[name], table["switch"]), switches, largest[name], _spike_list(table, name)
        )
        for name in MEASURES
    ]


def _sentence(name: str, alignment: Alignment, switches: int, largest: float, places: str) -> str:
    at = counted(switches, "contact switch", "contact switches")
    if not alignment.spikes:
        return f"{name} has no spike at the {at}: it changes by at most {three_digits(largest)}x over a step."
    share, chance = _percent(alignment.near / alignment.spikes), _percent(alignment.chance)
    return (
        f"{name}: {counted(alignment.spikes, 'spike')} (largest tenth of the changes, above {SPIKE:g}x per step), "
        f"{alignment.near} within one step of the {at}: {share} against {chance} by chance, p = {alignment.p_value:.2g}. "
        f"{_conclusion(alignment)}{places}"
    )


def _switch_list(table: pd.DataFrame) -> list[str]:
    """Return a sentence with the first switches: which contact is made or lost at which state."""
    if "switched" not in table or not table["switch"].any():
        return []
    switches = [f"{step} {name}" for step, name in zip(table["step"], table["switched"], strict=True) if name]
    more = f", and {len(switches) - LISTED} more (column switched)" if len(switches) > LISTED else ""
    return [f"Contact switches, by step: {'; '.join(switches[:LISTED])}{more}."]


def _spike_list(table: pd.DataFrame, name: str) -> str:
    """Return a sentence with the largest spikes of a measure, each with the contact switches within one step of it."""
    if "switched" not in table:
        return ""
    sizes, at = changes(table[name]), np.flatnonzero(spikes(table[name]))
    largest = sorted(sorted(at, key=lambda k: -sizes[k])[:LISTED])
    parts = []
    for k in largest:
        near = dict.fromkeys(name for name in table["switched"].iloc[k : k + 3] if name)
        parts.append(f"{k + 1} ({three_digits(float(np.exp(sizes[k])))}x, {', '.join(near) or 'no switch'})")
    which = "The spikes are" if len(at) > 1 else "The spike is"
    which = which if len(largest) == len(at) else "The largest spikes are"
    return f" {which} at {'steps' if len(parts) > 1 else 'step'} {'; '.join(parts)}."


def _conclusion(alignment: Alignment) -> str:
    if alignment.near == 0:
        return "No spike lines up with a contact switch."
    if alignment.p_value <= LEVEL:
        return "Spikes line up with contact switches."
    return "Some spikes are at contact switches, but chance could explain that."


def three_digits(value: float) -> str:
    """Return a number as text with three digits, and an exponent only where necessary.

    >>> three_digits(0.0126), three_digits(1900.0), three_digits(2.5e7)
    ('0.0126', '1,900', '2.5e+07')
    """
    return f"{value:,.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f}%"


def _contact_summary(table: pd.DataFrame) -> str:
    if table["gap"].isna().all():
        return f"{len(table) - 1} steps, no contacts in this scene."
    touching = int((table["contacts"] > 0).sum())
    return (
        f"{len(table) - 1} steps; {touching} of {len(table)} states in contact, "
        f"{counted(int(table['switch'].sum()), 'switch', 'switches')}; penetration up to "
        f"{three_digits(table['penetration'].max())} m, force up to {three_digits(table['force'].max())} N."
    )


def _gradient_summary(table: pd.DataFrame, gradient_error: float) -> str:
    norms = table[list(MEASURES)].replace([np.inf, -np.inf], np.nan)
    ranges = [f"{MEASURES[n]} {three_digits(norms[n].min())} to {three_digits(norms[n].max())}" for n in MEASURES]
    return f"{', '.join(ranges)}; the adjoints' gradient is within {gradient_error:.1g} of the program's."
