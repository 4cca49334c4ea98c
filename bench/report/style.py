"""What things look like in every chart: colours, markers, line styles, and names and numbers as printed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd

from bench.report.views import UNITS, Line, axis_value, short_axis

PALETTE = ("#0072B2", "#000000", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F6000")
"""Colours told apart by colour-blind readers (Okabe and Ito, yellow replaced by brown for white paper)."""
MARKERS = "osD^vPX*"
VARIANTS = ("-", (0, (4, 1.5)), (0, (1, 1.2)))
"""Line styles of one estimator's parameter variants."""
DEVIANT = ((0, (6, 1.5, 1, 1.5)), (0, (6, 1.5, 1, 1.5, 1, 1.5)), (0, (2, 2)))
"""Line styles of backends whose numbers differ from the first backend's."""
MARKS = ((0, (3, 2)), (0, (1, 1.5)), (0, (5, 1, 1, 1)))
"""Line styles of marked values on an axis."""
GREY = "#404040"
SHADE: dict[str, Any] = {"color": "#d9d9d9", "alpha": 0.5, "linewidth": 0}
CROSS: dict[str, Any] = {"marker": "x", "markersize": 5, "markeredgewidth": 1.4, "linestyle": "none"}
TICK: dict[str, Any] = {"marker": "|", "markersize": 9, "markeredgewidth": 2, "linestyle": "none"}
FRONT: dict[str, Any] = {"color": "#bdbdbd", "linewidth": 3, "label": "Pareto front"}
SIZE = 8
STYLE: dict[str, Any] = {
    **dict.fromkeys(("font.size", "axes.titlesize", "axes.labelsize", "legend.fontsize"), SIZE),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize"), SIZE),
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.5,
    "legend.frameon": False,
    "svg.hashsalt": "bench",
    "pdf.fonttype": 42,
}
SYMBOLS = {
    "horizon": "$T$",
    "dt": r"$\Delta t$",
    "stiffness": "$k$",
    "sigma": r"$\sigma$",
    "samples": "$N$",
    "repeats": "$R$",
    "beta": r"$\beta$",
    "kappa": r"$\kappa$",
}
WORDS = {"dt": "time step", "sigma": "noise", "beta": "sharpness", "kappa": "central-path"}
"""What an axis is called before its symbol, where not by its parameter's name."""


class Look:
    """The colour, marker and line style of every estimator and backend, the same in all charts."""

    def __init__(self, rows: pd.DataFrame, names: Sequence[str]) -> None:
        self._names = [*names, *sorted(set(rows["estimator"]) - set(names))]
        self._variants = sorted(set(zip(rows["estimator"], rows["estimator_params"], strict=True)))
        self._backends = list(dict.fromkeys(rows["backend"]))

    def line(self, line: Line) -> dict[str, Any]:
        """The colour and line style of an estimator and its parameters."""
        colour = PALETTE[self._names.index(line.estimator) % len(PALETTE)]
        return {"color": colour, "linestyle": VARIANTS[self._variant(line) % len(VARIANTS)]}

    def marked(self, line: Line) -> dict[str, Any]:
        """The line with the marker of an estimator and its parameters."""
        place = self._names.index(line.estimator)
        marker = MARKERS[(place + place // len(PALETTE) + 3 * self._variant(line)) % len(MARKERS)]
        return {**self.line(line), "marker": marker}

    def backend(self, name: str) -> str:
        """The marker of a backend, in charts that tell backends apart."""
        return MARKERS[self._backends.index(name) % len(MARKERS)]

    def _variant(self, line: Line) -> int:
        known = [params for estimator, params in self._variants if estimator == line.estimator]
        return known.index(line.params) if line.params in known else 0


def twin(line: Line, found: Sequence[Line]) -> int:
    """How many lines of the same estimator come before this one, of other backends."""
    return [other for other in found if other.label == line.label].index(line)


def axis_name(axis: str) -> str:
    """An axis in words, with its symbol and unit: ``stiffness $k$ [N/m]``."""
    name = short_axis(axis)
    unit = f"[{UNITS[name]}]" if name in UNITS else ""
    return " ".join(filter(None, [WORDS.get(name, plain(name)), SYMBOLS.get(name, ""), unit]))


def quantity(name: str, value: float) -> str:
    """``$k$ = 1000 N/m``."""
    text = axis_value(value)
    mantissa, _, power = text.partition("e")
    if power:
        text = f"$10^{{{power}}}$" if mantissa == "1" else rf"${mantissa}\times 10^{{{power}}}$"
    return f"{SYMBOLS.get(name, plain(name))} = {text}" + (f" {UNITS[name]}" if name in UNITS else "")


def plain(text: str) -> str:
    """Text that is not taken for a formula, nor left out of a legend for its underscore."""
    text = " ".join(text.split()).replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def inches(text: str) -> float:
    """The width of a text as printed."""
    from matplotlib.textpath import TextPath

    return float(TextPath((0, 0), text, size=SIZE).get_extents().width / 72) if text.strip() else 0.0


def wrapped(parts: Sequence[str], width: float) -> str:
    """Parts joined by commas, in lines of at most ``width`` inches where a part is not longer."""
    out = ""
    for part in filter(None, parts):
        last = out.rpartition("\n")[2]
        out += ("" if not out else ", " if inches(f"{last}, {part}") <= width else ",\n") + part
    return out
