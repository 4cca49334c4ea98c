"""Lists the facts of a trace, a line each: contact, switches, and per measure its range and its spikes."""

from __future__ import annotations

import numpy as np
import pandas as pd

from bench.report.text import number
from bench.trace.contacts import TOUCHES
from bench.trace.spikes import LEVEL, MEASURES, Alignment, align, changes, spikes

LISTED = 5
"""Most switches and spikes that a line lists, by step."""


def report(table: pd.DataFrame, gradient_error: float) -> list[str]:
    """Return lines on contact, switches, the adjoints' gradient, and the spikes of each measure."""
    switches = np.flatnonzero(table["switch"])
    facts = {
        "steps": len(table) - 1,
        "states in contact": int((table["contacts"] > 0).sum()),
        "largest penetration [m]": table["penetration"].max(),
        "largest force [N]": table["force"].max(),
        "relative error of the adjoints' gradient": gradient_error,
        "contact switches": len(switches),
    }
    values = [
        f"{name} {value if isinstance(value, int) else number(value, 3)}"
        for name, value in facts.items()
        if np.isfinite(value)
    ]
    touches = [
        f"{name.removeprefix(TOUCHES)} {table[name].sum()}"
        for name in table
        if name.startswith(TOUCHES) and table[name].any()
    ]
    named = [f"states in contact, by contact: {', '.join(touches)}"] if touches else []
    return [f"{', '.join(values)}{_at(switches)}", *named, *verdict(table)]


def _at(steps: np.ndarray) -> str:
    return f", at {', '.join(map(str, steps[:LISTED]))}{' ...' * (len(steps) > LISTED)}" if len(steps) else ""


def verdict(table: pd.DataFrame) -> list[str]:
    """Return a line per measure: its range, its spikes, and whether they line up with contact switches."""
    lines = []
    for name, title in MEASURES.items():
        norms, found, sizes = (
            table[name].replace(np.inf, np.nan),
            align(table[name], table["switch"]),
            changes(table[name]),
        )
        facts = (
            f"{number(norms.min(), 3)} to {number(norms.max(), 3)}; at most {number(np.exp(sizes.max()), 3)}x per step"
        )
        if found.spikes:
            at = sorted(np.flatnonzero(spikes(table[name])), key=lambda k: -sizes[k])
            facts += (
                f"; {found.near} of {found.spikes} spikes within a step of a switch, {found.chance:.0%} by chance, "
                f"p = {found.p_value:.2g}{_at(np.array(at) + 1)}"
            )
        lines.append(f"{title}: {conclusion(found, int(table['switch'].sum()))} ({facts})")
    return lines


def conclusion(alignment: Alignment, switches: int) -> str:
    """Return whether spikes line up with contact switches."""
    if not switches or not alignment.spikes:
        return "no spikes" if switches else "no contact switches"
    if alignment.near == 0:
        return "spikes do not line up with contact switches"
    return "spikes line up with contact switches" if alignment.p_value <= LEVEL else "open: chance could explain it"
