"""Writes tables as Markdown and LaTeX: escaping, numbers aligned, CSV with every digit."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import pandas as pd

from bench.report.text import one_line

WHOLE = ("horizon", "samples", "repeats", "dim", "seed")
"""Columns of whole numbers, which pandas would write with a decimal point."""


def csv(table: pd.DataFrame) -> str:
    """Write a table as CSV, with every digit of every number."""
    whole = [name for name in WHOLE if name in table and (table[name].dropna() % 1 == 0).all()]
    return table.astype(dict.fromkeys(whole, "Int64")).to_csv(index=False, lineterminator="\n")


NUMBER = re.compile(r"(-?)(\d+)(?:\.(\d+))?(?:e(-?)(\d+))?")
"""A number as tables print it: sign, whole and decimal digits, sign and digits of its exponent."""


def number_format(texts: Sequence[str]) -> str:
    """Return the ``table-format`` that holds all numbers of a column: ``-3.2e-1``."""
    matches = [match.groups(default="") for match in map(NUMBER.fullmatch, texts) if match]
    if not matches:
        return "1.0"
    sign, power_sign = ("-" if any(parts[i] for parts in matches) else "" for i in (0, 3))
    whole, decimals, power = (max(len(parts[i]) for parts in matches) for i in (1, 2, 4))
    return f"{sign}{whole}" + (f".{decimals}" if decimals else "") + (f"e{power_sign}{power}" if power else "")


def latex_number(text: str) -> str:
    """Return a number for siunitx to align; put anything else in braces."""
    return text if NUMBER.fullmatch(text) else f"{{{escape_latex(text)}}}"


def plain_markdown(table: pd.DataFrame, heads: Mapping[str, str] = MappingProxyType({})) -> str:
    """Write a table of texts in Markdown; ``heads`` are headings for columns whose names do not say it."""
    out = ["| " + " | ".join(heads.get(name, name) for name in table) + " |", "|" + "---|" * table.shape[1]]
    out += ["| " + " | ".join(map(escape_markdown, map(str, row))) + " |" for row in table.fillna("").to_numpy()]
    return "\n".join(out)


def escape_markdown(text: str) -> str:
    """Escape text so that a Markdown renderer shows it as it is, in a table cell too."""
    text = one_line(text).replace("&", "&amp;")
    text = re.sub(r"<(?! )", "&lt;", text).replace(">", "&gt;")
    text = re.sub(r"([\\`*|$~])", r"\\\1", text).replace("](", r"]\(")
    return re.sub(r"(?<!\w)_|_(?!\w)", r"\\_", text)


def escape_latex(text: str) -> str:
    """Escape text so that LaTeX prints it as it is."""
    special = {c: rf"\{c}" for c in "&%$#_{}"} | {
        "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$",
        "|": "$|$", "[": "{[}", "]": "{]}",
    }  # fmt: skip
    return "".join(special.get(c, c) for c in one_line(text))
