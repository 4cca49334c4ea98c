"""Writes ``index.html``, a page with the state and the finding of every experiment in a results folder."""

from __future__ import annotations

import html
import json
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from bench.errors import UserError
from bench.report.text import counted
from bench.report.web import shell
from bench.run.files import write_whole

GOOD = ("ok", "unsupported", "unavailable")
"""Statuses that do not count as failures: the cell has a result, or was refused with a reason."""


def write(folder: Path) -> Path:
    """Write ``index.html`` into a results folder and return its path.

    Raises :class:`UserError` if the folder does not exist or contains no experiment.
    """
    if not folder.is_dir():
        raise UserError(f"'{folder}' is not a folder")
    places = sorted(
        {path.parent for path in folder.rglob("rows.parquet")} | {p.parent for p in folder.rglob("run.json")}
    )
    if not places:
        raise UserError(f"'{folder}' has no experiments: no rows.parquet and no run.json below it")
    articles = "\n".join(_article(folder, place) for place in places)
    title = f"Results in {folder.name or folder.resolve().name}"
    body = (
        f"<header><h1>{html.escape(title)}</h1><p>{counted(len(places), 'experiment')}.</p></header>\n"
        f"<main>\n{articles}\n</main>"
    )
    text = shell.document(title, body)
    path = folder / "index.html"
    write_whole(path, text.encode())
    return path


def _article(folder: Path, place: Path) -> str:
    """Return the HTML of one experiment: its question, finding, state, and links to its files."""
    e = html.escape
    record = _record(place / "run.json")
    name = str(record.get("experiment") or place.name)
    relative = place.relative_to(folder)
    page = place / "report.html"
    heading = f'<a href="{e((relative / page.name).as_posix())}">{e(name)}</a>' if page.exists() else e(name)
    parts = [f"<h2>{heading}</h2>"]
    if record.get("question"):
        parts.append(f"<p><em>{e(str(record['question']))}</em></p>")
    if finding := _finding(page):
        parts.append(f"<p>{finding}</p>")
    parts.append(f'<p class="state">{_state(place / "rows.parquet", record)}</p>')
    notes = [str(record[key]) for key in ("finished", "git_commit") if record.get(key)]
    notes[1:] = [f"commit {commit[:12]}" for commit in notes[1:]]
    files = sorted(path.name for path in place.iterdir() if path.suffix in (".md", ".csv", ".png", ".tex"))
    links = [f'<a href="{e((relative / file).as_posix())}">{e(file)}</a>' for file in files if "plotted" not in file]
    if not page.exists():
        notes.append("no page yet: python -m bench report writes it")
    parts.append(f'<p class="soft">{e("; ".join(notes))}<br>{", ".join(links)}</p>')
    return "<article>\n" + "\n".join(parts) + "\n</article>"


def _state(path: Path, record: dict[str, Any]) -> str:
    """Return the HTML of the number of cells by status, failures marked, or a note that the rows cannot be read."""
    counts: dict[str, int] = {}
    if path.exists():
        try:
            table = pd.read_parquet(path, columns=["status", "stored_at"])
        except Exception as error:  # any error in the file is reported on the page
            return f'<span class="bad">rows.parquet cannot be read: {html.escape(str(error)[:200])}</span>'
        counts = {str(status): int(count) for status, count in table["status"].value_counts().items()}
        newest = table["stored_at"].max()
    else:
        newest = float("nan")
        counts = {str(k): int(v) for k, v in record.get("counts", {}).items()}
    texts = [
        f"<span{'' if status in GOOD else ' class=bad'}>{count} {html.escape(status)}</span>"
        for status, count in counts.items()
    ]
    when = time.strftime(", newest of %Y-%m-%d %H:%M UTC", time.gmtime(newest)) if newest == newest else ""
    return f"{counted(sum(counts.values()), 'cell')}: {', '.join(texts) or 'none'}{when}"


def _finding(page: Path) -> str:
    """Return the finding of an experiment's page as escaped HTML; empty without a page."""
    try:
        text = page.read_text(errors="replace")
    except OSError:
        return ""
    match = re.search(r'id="finding">(.*?)</p>', text, re.DOTALL)
    # each part of the finding is one element on the page
    text = re.sub(r"<(?!/?(br|b|em)\b)[^>]*>", "; ", match[1]) if match else ""
    return re.sub(r"(\s*;\s*)+", "; ", re.sub(r"(&\w+);", r"\1\0", text)).strip("; ").replace("\0", ";")


def _record(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def main(words: Sequence[str]) -> int:
    """Write the index of the folder in ``words``, by default ``results``, and return the exit status 0."""
    if len(words) > 1 or any(word.startswith("-") or "=" in word for word in words):
        raise UserError("name one folder of results: python -m bench index [DIR]")
    path = write(Path(words[0] if words else "results").expanduser())
    print(f"  {path}")
    return 0
