"""The style of all charts: colours, markers, line styles, and the format of names and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import pandas as pd

from bench.experiment.axes import Axis
from bench.experiment.columns import COMMON
from bench.report.text import axis_value, one_line
from bench.report.views import Curve

PALETTE = ("#0072B2", "#000000", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F6000")
"""Colours that colour-blind readers can distinguish (Okabe and Ito, yellow replaced by brown for white paper)."""
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
}
GREEK = ("alpha", "beta", "gamma", "delta", "kappa", "lambda", "mu", "nu", "rho", "tau")
"""Parameters named after Greek letters, printed as these letters."""

WORDS = {"dt": "time step", "sigma": "noise"}
"""Words for an axis's parameter if they differ from its name."""


class Styles:
    """The colour, marker and line style of each estimator and backend, the same in all charts.

    ``names`` are all registered estimators, so that an estimator's style does not depend on the others in a chart.
    Beyond the palette's length, hues repeat darker or lighter, with a different marker.
    """

    def __init__(self, rows: pd.DataFrame, names: Sequence[str]) -> None:
        self._names = [*names, *sorted(set(rows["estimator"]) - set(names))]
        self._variants = sorted(set(zip(rows["estimator"], rows["estimator_params"], strict=True)))
        self._backends = list(dict.fromkeys(rows["backend"]))

    def line(self, line: Curve) -> dict[str, Any]:
        """Return the colour and line style of an estimator and its parameters."""
        return {
            "color": colour(self._names.index(line.estimator)),
            "linestyle": VARIANTS[self._variant(line) % len(VARIANTS)],
        }

    def marked(self, line: Curve) -> dict[str, Any]:
        """Return the colour, line style and marker of an estimator and its parameters."""
        return {**self.line(line), "marker": marker(self._names.index(line.estimator), self._variant(line))}

    def backend(self, name: str) -> str:
        """Return the marker of a backend, in charts that distinguish backends."""
        return MARKERS[self._backends.index(name) % len(MARKERS)]

    def _variant(self, line: Curve) -> int:
        variants = [params for estimator, params in self._variants if estimator == line.estimator]
        return variants.index(line.params) if line.params in variants else 0


def colour(place: int) -> str:
    """Return the colour of a position, from 0: the palette, then its hues mixed with black or white; no colour repeats."""
    from matplotlib.colors import to_hex, to_rgb

    turn, index = divmod(place, len(PALETTE))
    if turn == 0:
        return PALETTE[index]
    # odd turns darken, even turns lighten, and each adds less than the one before; black can only be lightened
    share = 0.45 * 0.7 ** ((turn - 1) // 2)
    end = 1.0 if turn % 2 == 0 or PALETTE[index] == "#000000" else 0.0
    share = share / 2 if turn % 2 == 0 and PALETTE[index] == "#000000" else share
    red, green, blue = ((1 - share) * part + share * end for part in to_rgb(PALETTE[index]))
    return to_hex((red, green, blue))


def marker(place: int, variant: int = 0) -> str:
    """Return the marker of a position, from 0, and of a variant, from 0."""
    return MARKERS[(place + place // len(PALETTE) + 3 * variant) % len(MARKERS)]


def backend_rank(line: Curve, lines: Sequence[Curve]) -> int:
    """Return a line's position, from 0, among the lines of the same estimator on several backends."""
    return [other for other in lines if other.label == line.label].index(line)


def axis_name(axis: Axis) -> str:
    """Return the label of an axis: name, symbol, unit and the parameters that step with it, ``stiffness $k$ [N/m]``."""
    unit = f"[{axis.unit}]" if axis.unit else ""
    name = " ".join(filter(None, [WORDS.get(axis.column, plain(axis.column)), symbol(axis.column), unit]))
    return name + (f", {' and '.join(map(plain, axis.moves))} with it" if axis.moves else "")


def symbol(name: str) -> str:
    """Return the symbol of a quantity in formulas; empty if it has none."""
    return SYMBOLS.get(name, rf"$\{name}$" if name in GREEK else "")


def quantity(name: str, value: float) -> str:
    """Format a quantity with its value and unit: ``$k$ = 1000 N/m``."""
    text = axis_value(value)
    mantissa, _, power = text.partition("e")
    if power:
        text = f"$10^{{{power}}}$" if mantissa == "1" else rf"${mantissa}\times 10^{{{power}}}$"
    unit = COMMON[name].unit if name in COMMON else ""
    return f"{symbol(name) or plain(name)} = {text}" + (f" {unit}" if unit else "")


def plain(text: str) -> str:
    """Return text escaped for Matplotlib: not parsed as a formula, not hidden in legends for a leading underscore."""
    text = one_line(text).replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


@cache
def width_in_inches(text: str) -> float:
    """Return the printed width of a string in inches, at the charts' font size."""
    from matplotlib.cbook import is_math_text
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    formula = is_math_text(text)
    shown = text if formula else text.replace(r"\$", "$")
    width, _, _ = text_to_path.get_text_width_height_descent(shown, FontProperties(size=SIZE), formula)
    return float(width / 72)


def wrapped(parts: Sequence[str], width: float, between: str = ", ") -> str:
    """Return parts joined by ``between``, in lines of at most ``width`` inches unless a single part is longer."""
    out = ""
    for part in filter(None, parts):
        last = out.rpartition("\n")[2]
        out += (
            "" if not out else between if width_in_inches(last + between + part) <= width else between.rstrip() + "\n"
        ) + part
    return out
