"""Writes ``index.html``: the questions of a results folder, and a card per experiment with a chart, the answer and the state.

All texts come from stored files, which may be foreign: they are shown literally, and nothing is read from other pages.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd

from bench.errors import UserError, local_path
from bench.experiment.words import parse_words
from bench.report.text import counted
from bench.report.web import shell
from bench.run.files import write_whole
from bench.run.rows import read_object, read_parquet

GOOD = ("ok", "unsupported", "unavailable", "waiting")
"""Statuses that do not count as failures: the cell has a result, or was refused with a reason."""
OWN_FILES = ("rows.parquet", "run.json", "answer.json")
"""Files whose folder is listed."""


def write(folder: Path) -> Path:
    """Write ``index.html`` into a results folder and return its path.

    Raises :class:`UserError` if the folder does not exist or contains no experiment.
    """
    if not folder.is_dir():
        raise UserError(f"'{folder}' is not a folder")
    places = sorted({path.parent for name in OWN_FILES for path in folder.rglob(name)})
    if not places:
        raise UserError(f"'{folder}' has no experiments: no {', no '.join(OWN_FILES)} below it")
    title = f"Results in {folder.name or folder.resolve().name}"
    notes = [f"<p>{counted(len(places), 'experiment')}.</p>"]
    if any(_page(place) is None for place in places):
        command = f"python -m bench report +experiment=NAME results_dir={folder}"
        notes.append(f'<p class="hint">Some have no page yet: <code>{escape(command)}</code> writes one.</p>')
    cards = "\n".join(f'<article id="e{i}">\n{_card(folder, place)}\n</article>' for i, place in enumerate(places))
    asked: dict[str, list[str]] = {}
    for i, place in enumerate(places):
        texts = _texts(place)
        link = f'<a href="#e{i}">{escape(texts.get("experiment", place.name))}</a>'
        asked.setdefault(texts.get("question", ""), []).append(link)
    listed = "".join(f"<li>{escape(question)} {', '.join(links)}</li>" for question, links in sorted(asked.items()))
    header = f"<header><h1>{escape(title)}</h1>{''.join(notes)}<nav><ul>{listed}</ul></nav></header>"
    path = folder / "index.html"
    body = f'{header}\n<main class="cards">\n{cards}\n</main>'
    write_whole(path, shell.document(title, body, has_local_images=True).encode())
    return path


def _texts(place: Path) -> dict[str, str]:
    """Return the texts of an experiment's record and answer."""
    sources = (read_object(place / name) for name in ("run.json", "answer.json"))
    return {key: text for source in sources for key, text in source.items() if text and isinstance(text, str)}


def _card(folder: Path, place: Path) -> str:
    """Return the HTML of one experiment: chart, question, answer, state, one button, and its files folded away."""
    record, texts = read_object(place / "run.json"), _texts(place)
    name, page, chart = texts.get("experiment", place.name), _page(place), _chart(place, texts.get("chart", ""))
    state, when = _state(place / "rows.parquet", record.get("counts"), texts.get("finished", ""))
    parts = (
        ['<div class="none">no chart</div>']
        if chart is None
        else [f'<img src="{_link(folder, chart)}" alt="{escape(f"The chart {chart.stem} of {name}")}" loading="lazy">']
    )
    parts.append(f"<h2>{escape(name)}</h2>")
    for look, text in (
        ("hint", escape(texts.get("question", ""))),
        ("answer", escape(texts.get("answer", ""))),
        ("state", state),
    ):
        parts += [f'<p class="{look}">{text}</p>'] * bool(text)
    if target := page or chart:
        label = "Open the page" if page else "Open the chart"
        named = escape(f"{label} of {name}")
        parts.append(f'<a class="button" href="{_link(folder, target)}" aria-label="{named}">{label}</a>')
    notes = [when, *(f"commit {text[:12]}" for key, text in texts.items() if key == "git_commit")]
    suffixes = (".html", ".md", ".csv", ".tex", ".png", ".svg", ".pdf")
    files = sorted(path for path in place.iterdir() if path.suffix in suffixes and ".plotted" not in path.name)
    links = "".join(f'<li><a href="{_link(folder, path)}">{escape(path.name)}</a></li>' for path in files)
    parts.append(
        f"<details><summary>{counted(len(files), 'file')}</summary>"
        f"<p>{escape('; '.join(filter(None, notes)))}</p><ul>{links}</ul></details>"
    )
    return "\n".join(parts)


def _page(place: Path) -> Path | None:
    """Return the page of an experiment, or of the claims; None if it has not been written."""
    return next((path for name in ("report.html", "claims.html") if (path := place / name).is_file()), None)


def _chart(place: Path, stem: str) -> Path | None:
    """Return the chart with this stem, else the first chart of the folder; None without charts."""
    charts = sorted(place.glob("*.png"))
    return next((path for path in charts if path.stem == stem), charts[0] if charts else None)


def _link(folder: Path, path: Path) -> str:
    """Return the relative address of a file; quoted, so that no name of a folder is taken for a scheme or a query."""
    return escape(quote(path.relative_to(folder).as_posix()))


def _state(path: Path, counts: Any, when: str) -> tuple[str, str]:
    """Return the number of cells by status as HTML, failures marked, and the date of the newest row as text.

    Without rows they are ``counts`` and ``when`` of the record of the run.
    """
    if path.exists():
        try:
            table = read_parquet(path, ["status", "stored_at"])
            counts = table["status"].value_counts().to_dict()
            newest = float(pd.to_numeric(table["stored_at"], errors="coerce").max())
            # no run has stored a row after the year 3000
            if 0 <= newest < 32503680000.0:
                when = time.strftime("newest row of %Y-%m-%d %H:%M UTC", time.gmtime(newest))
        except Exception as error:  # any error in the file is reported on the page
            return f'<span class="bad">rows.parquet cannot be read: {escape(str(error)[:200])}</span>', ""
    known = counts.items() if isinstance(counts, dict) else ()
    looks = {status: "" if status in GOOD else ' class="bad"' for status, _ in known}
    texts = [f"<span{looks[status]}>{escape(f'{count} {status}')}</span>" for status, count in known]
    return ", ".join(texts), when


def main(words: Sequence[str]) -> int:
    """Write the index of the folder in ``words``, by default ``results``, and return the exit status 0."""
    names, _, _ = parse_words(words, "index", {})
    if len(names) > 1:
        raise UserError("name one folder of results: python -m bench index [DIR]")
    path = write(local_path("DIR", next(iter(names), "results")))
    print(f"  {path}")
    return 0
