"""Wraps the body of a page in one HTML document: one stylesheet for light, dark and paper, and one security policy."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Sequence
from functools import cache
from html import escape
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from bench.report.figures import inline_svg

HERE = Path(__file__).parent


def document(title: str, body: str, scripts: Sequence[str] = (), has_local_images: bool = False) -> str:
    """Return a complete HTML document that loads nothing from a network.

    ``title`` is text, ``body`` is HTML whose texts are escaped already. Only ``scripts`` run, after the body and in their
    order: the policy names them by their hashes, so that markup which reaches a page by mistake cannot run code.
    Images are embedded, or with ``has_local_images`` also files beside the page.
    """
    hashes = " ".join(f"'sha256-{_digest(script)}'" for script in scripts) or "'none'"
    images = "data: 'self' file:" if has_local_images else "data:"
    policy = (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src {images}; "
        "base-uri 'none'; form-action 'none'"
    )
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)}</title>\n<style>\n{file_text('page.css')}</style>\n</head>\n<body>\n{body}\n"
        f"{''.join(f'<script>{script}</script>{chr(10)}' for script in scripts)}</body>\n</html>\n"
    )


@cache
def file_text(name: str) -> str:
    """Return the text of a file of this folder."""
    return (HERE / name).read_text()


@cache
def _digest(script: str) -> str:
    """Return the hash of a script as base64, as a security policy names it."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def table(frame: pd.DataFrame) -> str:
    """Return a frame of texts as an HTML table, in a box that scrolls sideways where the window is narrow."""
    head = "".join(f'<th scope="col">{escape(str(name))}</th>' for name in frame)
    rows = frame.astype(str).to_numpy()
    lines = [f"<tr>{''.join(f'<td>{_breakable(text)}</td>' for text in row)}</tr>" for row in rows]
    return (
        f'<div class="scroll" tabindex="0"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def _breakable(text: str) -> str:
    """Return a text as HTML that may also break within a name and its settings."""
    return re.sub(r"(?<=\S)[,\[](?=\S)|_(?=[a-z]{6})", r"\g<0><wbr>", escape(text))


def drawing(widths: Sequence[Figure], name: str, description: str) -> str:
    """Return a chart in a box; no two of a page have one name. Of two ``widths`` the second is for narrow windows."""
    boxes = []
    for figure, kind in zip(widths, ("wide", "narrow") if len(widths) > 1 else ("",), strict=True):
        drawn = inline_svg(figure, f"{name}{kind}")
        drawn = drawn.replace("<svg", f'<svg role="img" aria-label="{escape(description)}"', 1)
        boxes.append(f'<div class="drawing {kind}">{drawn}</div>')
    return "".join(boxes)
