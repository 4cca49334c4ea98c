"""Every kind of page in a browser: accessible in light and dark, no wider than a phone, and silent."""

import re

import pytest
from helpers import experiment, page, row, small_rows, table

from bench.claims import page as claims_page
from bench.claims.claim import NOT_REPRODUCED, REPRODUCED, Claim, Figure
from bench.claims.results import ClaimResult
from bench.model import registry
from bench.report import index
from bench.report.web import shell

TEXT, MARK = 4.5, 3.0
"""Contrasts that WCAG 2.2 asks for at level AA: of text, and of marks such as points and lines."""
KINDS = ("study", "index", "claims")


class Lesson(Claim):
    """A claim for a page."""

    name, lesson, statement, source, learned = "T1", "A lesson", "one is <b>one</b>", "here & now", "it is one"

    def measure(self):
        """Nothing: results are given."""
        raise NotImplementedError


class Other(Lesson):
    """Another claim, of another lesson."""

    name, lesson, learned = "T2", "Another lesson", "two is wrong"


LONG = "a quantity with_a_name_that_is_longer_than_the_window_of_a_phone_and_has_no_place_to_break"
RESULTS = [
    (Lesson, ClaimResult("T1", REPRODUCED, 1.0, (Figure(LONG, "1.00", 1.0),), series={"x": [0, 1], "y": [0, 1]})),
    (Other, ClaimResult("T2", NOT_REPRODUCED, 1.0, (Figure("two", "2.00", 2.5),), "<b>too coarse</b>")),
]


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The path of a page of each kind."""
    folder = tmp_path_factory.mktemp("pages")
    made = experiment()
    study = folder / "mine" / "report.html"
    study.parent.mkdir()
    rows = small_rows()
    rows.to_parquet(study.parent / "rows.parquet")
    study.write_text(page(made, rows))
    (folder / "claims").mkdir()
    claims_page.write(folder / "claims", RESULTS)
    paths = (study, index.write(folder), folder / "claims" / "claims.html")
    return dict(zip(KINDS, paths, strict=True))


@pytest.fixture(autouse=True)
def silent(browser):
    """Start each test with a wide light window; no page may complain or ask for anything."""
    browser.size(1280, 900)
    yield
    assert browser.said == browser.requests == []


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("kind", KINDS)
def test_axe_finds_nothing(kind, dark, pages, browser):
    browser.size(1280, 900, dark)
    browser.open(pages[kind])
    assert browser.violations() == []


@pytest.mark.parametrize("kind", KINDS)
def test_a_phone_needs_no_sideways_scrolling(kind, pages, browser):
    browser.size(390, 844)
    browser.open(pages[kind])
    assert browser.overflow() == 0


def luminance(colour):
    """The relative luminance of ``rgb(r, g, b)`` by WCAG 2."""
    parts = [float(part) / 255 for part in re.findall(r"[\d.]+", colour)[:3]]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def seen(colour, dark):
    """A colour of a drawing as the page shows it: on a dark ground inverted, with its hue."""
    parts = [float(part) / 255 for part in re.findall(r"[\d.]+", colour)[:3]]
    if dark:
        turned = [[-0.574, 1.43, 0.144], [0.426, 0.43, 0.144], [0.426, 1.43, -0.856]]
        parts = [min(max(sum(a * (1 - b) for a, b in zip(row, parts, strict=True)), 0.0), 1.0) for row in turned]
    return f"rgb({', '.join(str(255 * part) for part in parts)})"


def contrast(one, other):
    """The contrast of two colours by WCAG 2."""
    light, dark = sorted((luminance(one), luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


COLOURS = """[...document.querySelectorAll('.drawing text, .drawing use, .drawing path')].map((one) => {
  const style = getComputedStyle(one), isText = one.tagName === 'text';
  const isMark = one.tagName === 'use' || (style.stroke !== 'none' && one.getBBox().width > 30);
  return [isText, isText ? style.fill : isMark ? style.stroke : null, one.textContent];
}).filter(([, colour]) => colour && colour !== 'none')"""


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_charts_have_the_contrast_of_level_aa(dark, browser, tmp_path):
    """Of every colour of the palette and of those beyond it, and with names of backends beside points."""
    estimators = [*registry.entries()["estimators"], "unknown"]
    rows = [
        row(
            stiffness=k,
            backend=backend,
            estimator=e,
            time_s=1e-3 * (3 * place + i + 1),
            rmse_rel=0.1 + 0.02 * place + i,
        )
        for place, e in enumerate(estimators)
        for i, backend in enumerate(("one", "two"))
        for k in (1.0, 10.0)
    ]
    made = experiment(sweep={"stiffness": [1.0, 10.0]}, marks={"stiffness": {"limit": 5.0}})
    browser.size(1280, 4000, dark)
    browser.show(tmp_path, page(made, table(rows)))
    ground = browser.do("getComputedStyle(document.body).backgroundColor")
    found = browser.do(COLOURS)
    assert len(found) > 4 * len(estimators)
    for is_text, colour, text in found:
        if colour == "rgb(255, 255, 255)":
            continue  # on the dark cells of a table, the gaps between cells, and the inside of hollow markers
        assert contrast(seen(colour, dark), ground) >= (TEXT if is_text else MARK), (colour, text)


def test_a_script_that_reaches_a_page_does_not_run(browser, tmp_path):
    body = "<main><script>window.hacked = 1</script><img src=x onerror='window.hacked = 1'><p onclick='window.hacked = 1'>x</p></main>"
    browser.show(tmp_path, shell.document("A <title>", body, ["window.ours = 1"]))
    browser.do("document.querySelector('p').click()")
    assert browser.do("[window.hacked === undefined, window.ours, document.title]") == [True, 1, "A <title>"]
    assert any("Content Security Policy" in text for text in browser.said)
    browser.said.clear()
