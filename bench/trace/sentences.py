"""Lists the facts of a trace, a line each: contact, switches, and per measure its range and its spikes."""

from __future__ import annotations

import numpy as np
import pandas as pd

from bench.trace.spikes import LEVEL, MEASURES, Alignment, align, changes, spikes

LISTED = 5
"""Most switches and spikes that a line lists."""


def report(table: pd.DataFrame, gradient_error: float) -> list[str]:
    """Return lines on contact, switches, the adjoints' gradient, and the spikes of each measure."""
    facts = {"steps": len(table) - 1, "states in contact": int((table["contacts"] > 0).sum())}
    facts |= {"contact switches": int(table["switch"].sum())}
    sizes = {"penetration [m]": table["penetration"].max(), "force [N]": table["force"].max()}
    values = [f"{name} {value}" for name, value in facts.items()]
    values += [f"{name} up to {three_digits(value)}" for name, value in sizes.items() if np.isfinite(value)]
    values.append(f"adjoints' gradient within {gradient_error:.1g} of the program's")
    switched = table.get("switched", pd.Series("", table.index))
    switches = [f"{step} {name}" for step, name in zip(table.get("step", table.index), switched, strict=True) if name]
    listed = (
        [f"switches, by step: {'; '.join(switches[:LISTED])}{' ...' * (len(switches) > LISTED)}"] if switches else []
    )
    return [", ".join(values), *listed, *verdict(table)]


def verdict(table: pd.DataFrame) -> list[str]:
    """Return a line per measure: its range, its spikes, and whether they line up with contact switches."""
    lines = []
    for name, title in MEASURES.items():
        norms, alignment, sizes = (
            table[name].replace(np.inf, np.nan),
            align(table[name], table["switch"]),
            changes(table[name]),
        )
        facts = [
            f"{three_digits(norms.min())} to {three_digits(norms.max())}",
            f"at most {three_digits(float(np.exp(sizes.max())))}x per step",
        ]
        if alignment.spikes:
            facts.append(
                f"{alignment.near} of {alignment.spikes} spikes within a step of a switch, {alignment.chance:.0%} by chance, "
                f"p = {alignment.p_value:.2g}"
            )
            at = sorted(np.flatnonzero(spikes(table[name])), key=lambda k: -sizes[k])[:LISTED]
            near = [", ".join(dict.fromkeys(filter(None, table.get("switched", [])[k : k + 3]))) for k in at]
            facts += [f"step {k + 1}: {n or 'no switch'}" for k, n in zip(at, near, strict=True)]
        lines.append(f"{title}: {conclusion(alignment, int(table['switch'].sum()))} ({'; '.join(facts)})")
    return lines


def conclusion(alignment: Alignment, switches: int) -> str:
    """Return whether spikes line up with contact switches."""
    if not switches or not alignment.spikes:
        return "no spikes" if switches else "no contact switches"
    if alignment.near == 0:
        return "spikes do not line up with contact switches"
    return "spikes line up with contact switches" if alignment.p_value <= LEVEL else "open: chance could explain it"


def three_digits(value: float) -> str:
    """Return a number as text with three digits, and an exponent only where necessary.

    >>> three_digits(0.0126), three_digits(1900.0), three_digits(2.5e7)
    ('0.0126', '1,900', '2.5e+07')
    """
    return f"{value:,.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"
