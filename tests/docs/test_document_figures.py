"""Each figure in the documents is computed from the stored results, or its section names the command that gives it."""

import re
from pathlib import Path

from bench.experiment import config
from docs import figures, website
from docs.results import PAPER

ROOT = Path(__file__).resolve().parents[2]
PAGES = {path: (ROOT / path).read_text() for path in website.PAGES.values()}
FREE = ("CHANGELOG.md", "CONTRIBUTING.md", "docs/columns.md", "docs/results.md", "docs/sources.md")
"""Documents without figures of their own: history, rules, and pages that are generated."""
NUMBER = re.compile(r"(?<![\w.,=/-])(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e-?\d+)?%?(?![\w-]|\.\d)")
PLAIN = re.compile(r"\d{1,2}|10*(?:,000)*%?|(?:19|20)\d\d|95%|2\.0|3\.11")
"""Numbers that are not figures: small counts, powers of ten, years, the level of intervals, versions."""


def sections(text):
    """The sections of a document, each with its heading and without code."""
    text = re.sub(r"^```.*?^```|^ {4,}\S[^\n]*$|`[^`\n]*`|\]\([^)]*\)", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.split(r"^(?=#+ )", text, flags=re.MULTILINE)


def test_every_figure_is_used():
    used = {match[1] for text in PAGES.values() for match in figures.MARK.finditer(text)}
    others = {name for name in used if "|" in name or name in config.experiments([PAPER])}
    assert used - others == set(figures.FIGURES)


def test_a_wrong_figure_is_written_again():
    wrong = "is <!--=trust-cells-->1<!--/--> of"
    right = figures.with_figures(wrong)
    assert right != wrong
    assert figures.with_figures(right) == right
    assert figures.without_marks(right) == f"is {figures.figure('trust-cells')} of"


def test_sections_with_figures_name_their_source():
    missing = []
    for path, section in [(page, part) for page in PAGES if page not in FREE for part in sections(PAGES[page])]:
        plain = figures.SOURCE.sub("", figures.MARK.sub("", section))
        numbers = [number for number in NUMBER.findall(plain) if not PLAIN.fullmatch(number)]
        if numbers and not figures.SOURCE.search(section):
            missing.append((path, section.partition("\n")[0], numbers))
    assert not missing, "add <!-- figures: COMMAND --> to these sections"


def test_named_sources_exist():
    for source in {source for text in PAGES.values() for source in figures.SOURCE.findall(text)}:
        files = re.findall(r"[\w/]+\.py", source)
        assert files or "python -m " in source or source in ("given", "the commands in the table"), source
        assert all((ROOT / file).exists() for file in files), source


def test_a_mark_in_a_sentence_does_not_start_its_line():
    """Markdown takes a line that starts with a comment for HTML, and shows its remainder as it stands."""
    starts = re.compile(r"^ *<!--=(?:(?!-->).)*-->[^\n]", re.MULTILINE)
    assert not [path for path, text in PAGES.items() if starts.search(text)]
