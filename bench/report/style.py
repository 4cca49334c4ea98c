"""The style of all charts: colours, markers, line styles, and the format of names and numbers."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

from bench.report.text import one_line

PALETTE = ("#0072B2", "#000000", "#D55E00", "#009E73", "#CC79A7", "#6E6200", "#009FBE", "#7406BE")
"""Colours that colour-blind readers can distinguish, with contrasts above 3 on white (Okabe and Ito, the light ones replaced)."""
MARKERS = "osD^vPX*"
VARIANTS = ("-", (0, (4, 1.5)), (0, (1, 1.2)), (0, (6, 1.5, 1, 1.5)))
"""Line styles of one estimator's parameter variants."""
MARKS = ((0, (3, 2)), (0, (1, 1.5)), (0, (5, 1, 1, 1)))
"""Line styles of marked values on an axis."""
GREY = "#404040"
SHADE: dict[str, Any] = {"color": "#bfbfbf", "alpha": 0.5, "linewidth": 0}
SIZE = 8
STYLE: dict[str, Any] = {
    **dict.fromkeys(("font.size", "axes.titlesize", "axes.labelsize", "legend.fontsize"), SIZE),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize"), SIZE),
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.xmargin": 0.08,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.5,
    "legend.frameon": False,
    "svg.hashsalt": "bench",
    "pdf.fonttype": 42,
}


def colour(place: int) -> str:
    """Return the colour of a position, from 0: the palette, then its hues darker, and black lighter; no colour repeats."""
    from matplotlib.colors import to_hex, to_rgb

    turn, index = divmod(place, len(PALETTE))
    if turn == 0:
        return PALETTE[index]
    share = 0.1 + 0.6 * (0.618034 * turn % 1)  # steps of the golden ratio never repeat
    end = 1.0 if PALETTE[index] == "#000000" else 0.0
    red, green, blue = ((1 - share) * part + share * end for part in to_rgb(PALETTE[index]))
    return to_hex((red, green, blue))


def marker(place: int, variant: int = 0) -> str:
    """Return the marker of a position, from 0, and of a variant, from 0."""
    return MARKERS[(place + place // len(PALETTE) + 3 * variant) % len(MARKERS)]


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


def filled(text: str, width: float, ends: str = r" ,/\[") -> str:
    """Break text after the characters ``ends`` into lines of at most ``width`` inches, measured in the charts' font."""
    lines: list[str] = []
    for paragraph in text.split("\n"):
        line = ""
        for piece in re.findall(rf"[^{ends}]+[{ends}]*|[{ends}]+", paragraph):
            if line and width_in_inches(plain((line + piece).rstrip())) > width:
                lines.append(line.rstrip())
                line = ""
            line += piece
        lines.append(line.rstrip())
    return "\n".join(lines)
