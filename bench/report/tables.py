"""Formats tables as CSV and Markdown, and escapes text for Markdown and LaTeX."""

from __future__ import annotations

import re

import pandas as pd

from bench.report.text import one_line

WHOLE = ("horizon", "samples", "repeats", "dim", "seed")
"""Columns of whole numbers, which pandas would write with a decimal point."""


def csv_text(table: pd.DataFrame) -> str:
    """Return a table as CSV with all digits of every number."""
    whole = [name for name in WHOLE if name in table and (table[name].dropna() % 1 == 0).all()]
    return str(table.astype(dict.fromkeys(whole, "Int64")).to_csv(index=False, lineterminator="\n"))


def plain_markdown(table: pd.DataFrame) -> str:
    """Return a table of strings in Markdown."""
    out = ["| " + " | ".join(table) + " |", "|" + "---|" * table.shape[1]]
    out += ["| " + " | ".join(map(escape_markdown, map(str, row))) + " |" for row in table.fillna("").to_numpy()]
    return "\n".join(out)


SPECIAL = re.compile(r"[&<>\\`*|$~_]|\]\(")
"""What :func:`escape_markdown` escapes."""


def escape_markdown(text: str) -> str:
    """Return text escaped so that a Markdown renderer prints it verbatim, also in a table cell."""
    text = one_line(text)
    if not SPECIAL.search(text):
        return text
    text = text.replace("&", "&amp;")
    text = re.sub(r"<(?! )", "&lt;", text).replace(">", "&gt;")
    text = re.sub(r"([\\`*|$~])", r"\\\1", text).replace("](", r"]\(")
    return re.sub(r"(?<!\w)_|_(?!\w)", r"\\_", text)


SIGNS = {
    "∞": r"$\infty$",
    "↑": r"$\uparrow$",
    "⧗": r"$\ominus$",
    "†": r"\dag",
    "‡": r"\ddag",
    "–": "--",
    "∅": r"$\emptyset$",
}
"""LaTeX for the signs of failed cells."""


def escape_latex(text: str) -> str:
    """Return text escaped so that LaTeX prints it verbatim."""
    special = (
        SIGNS
        | {c: rf"\{c}" for c in "&%$#_{}"}
        | {
            "\\": r"\textbackslash{}",
            "~": r"\textasciitilde{}",
            "^": r"\textasciicircum{}",
            "<": "$<$",
            ">": "$>$",
            "|": "$|$",
            "[": "{[}",
            "]": "{]}",
        }
    )
    return "".join(special.get(c, c) for c in one_line(text))
