"""The page of an experiment: what it says, that it stays literal, and what it does in a browser without a network."""

import html
import io
import json
import re
from dataclasses import replace

import helpers
import numpy as np
import pandas as pd
import pytest
from helpers import STIFFNESS, experiment, row, small_rows, stiffness_rows, table

from bench.experiment.columns import Column
from bench.experiment.views import Chart
from bench.report.finish import views_of
from bench.report.style import width_in_inches
from bench.report.web import shell
from bench.report.web.data import encode

HOSTILE = (
    "<script>window.hacked=1</script>",
    '<img src=x onerror="window.hacked=1">',
    "</script><b>bold</b>",
    "{{data}} & $x$",
)
"""Names that would do something if they were taken for HTML, or for a part of the page's template."""


def page(rows, study=None, **given):
    """The page of made-up rows, without drawings."""
    made = experiment(**given)
    if study is not None:
        made = replace(made, study=study)
    return helpers.page(made, rows, replace(views_of(made, rows), charts=[]))


@pytest.fixture(scope="module")
def text():
    """The page of a few rows, with a chart and the same under another name."""
    made, rows = experiment(), small_rows()
    along = views_of(made, small_rows(stiffness=STIFFNESS[:3])).charts[0]
    shown = replace(views_of(made, rows), charts=[along, replace(along, name="other")])
    return helpers.page(made, rows, shown)


def data_of(text):
    return json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])


def column(data, name):
    found = data["cells"][name]
    return [found["values"][i] for i in found["index"]] if isinstance(found, dict) else found


def finding(text):
    found = re.search(r'id="headline">(.*?)</p>', text, re.DOTALL)[1]
    return html.unescape(re.sub(r"<[^>]+>", "; ", found))


# ------------------------------------------------------------------------------------------------------- contents


def test_the_page_shows_what_to_use_where():
    rows = small_rows(backends=("jax",))
    table_of_uses = next(one for one in views_of(experiment(), rows).tables if one.page)
    shown = page(rows)
    assert all(html.escape(where) in shown for where in table_of_uses.frame["where"])


def test_the_page_says_when_nothing_ran():
    rows = table([row(stiffness=k) for k in (10.0, 100.0)])
    rows["status"], rows["reason"] = "error", "it broke"
    assert finding(page(rows)).startswith("No cell gave a result")


def test_every_row_is_in_the_page_with_its_status_and_reason():
    rows = small_rows()
    found = data_of(page(rows))
    for name in ("scene", "estimator", "status", "reason", "backend"):
        assert column(found, name) == list(rows[name])
    assert np.allclose(column(found, "stiffness"), rows["stiffness"])


def test_names_may_break_within_their_settings_and_intervals_may_not():
    found = shell.table(pd.DataFrame({"name": ["one[a=1,b=2]"], "value": ["0.95 [0.94, 0.96]"]}))
    assert "one[<wbr>a=1,<wbr>b=2]" in found
    assert "0.95 [0.94, 0.96]" in found


def test_numbers_keep_six_digits_and_missing_ones_are_null():
    assert encode(pd.Series([1.23456789, np.nan, np.inf, 3.0, 1e-30])) == [1.23457, None, None, 3, 1e-30]


def test_page_asks_for_nothing_and_stays_small(text):
    assert len(text) < 5e5
    assert text.count("<svg") == text.count('class="drawing ') >= 2
    assert not re.search(r'(src|href)="(?!#)', text.partition('id="data"')[0])
    assert "default-src 'none'" in text


# -------------------------------------------------------------------------------------------------------- browser

SVG = "document.querySelector('.drawing svg')"
WIDE = (1200, 3000)


@pytest.fixture(scope="module")
def opened(browser, text, tmp_path_factory):
    """The page of a few rows, opened once."""
    browser.size(*WIDE)
    browser.show(tmp_path_factory.mktemp("page"), text)
    return browser


@pytest.fixture
def shown(opened):
    """That page with nothing filtered, sorted or selected; it never complains and never asks for anything."""
    opened.size(*WIDE)
    opened.do("document.getElementById('clear').click(); state.sort = null; drawTable(); select(-1)")
    yield opened
    assert opened.said == []
    assert opened.requests == []


def test_unsteady_times_are_marked(browser, tmp_path):
    rows = table([row(stiffness=k, time_s=0.01, time_iqr_s=spread) for k, spread in ((1.0, 1e-4), (2.0, 5e-3))])
    browser.show(tmp_path, page(rows))
    assert browser.do("[0, 1].map((i) => shownAs(page.columns.find((c) => c.name === 'time_s'), i))") == [
        "10 ms",
        "10 ms !",
    ]


def test_errors_time_and_status_are_in_sight_on_a_laptop(browser, tmp_path):
    browser.size(1280, 900)
    browser.show(tmp_path, page(stiffness_rows()))
    heads = "[...document.querySelectorAll('#table th')]"
    for name in ("rel. RMSE", "rel. bias", "time", "status"):
        right = browser.do(f"{heads}.find((h) => h.textContent.trim() === '{name}').getBoundingClientRect().right")
        assert right <= 1280, name
    browser.size(*WIDE)


def test_print_fits_its_paper(shown):
    """What is wider than A4 between its margins would make a browser print everything smaller."""
    shown.size(718, 1000)
    shown.page.emulate_media(media="print")
    assert shown.do("document.documentElement.scrollWidth") <= 718
    assert shown.do(f"{SVG}.getBoundingClientRect().width") > 0.9 * 680


def test_filters_take_cells_stay_in_the_address_and_the_csv_has_what_is_shown(shown):
    rows = small_rows()
    address = shown.do("location.href.split('#')[0]")
    box = "document.querySelector('#filters details[data-column=estimator] input[value=fobg]')"
    shown.do(f"{box}.click()")
    link = shown.do("location.href")
    assert link.startswith(f"{address}#estimator=")
    assert "fobg" not in link
    left = rows[rows["estimator"] != "fobg"]
    back = pd.read_csv(io.StringIO(shown.do("csv()")))
    assert len(back) == len(left)
    assert set(back["estimator"]) == set(left["estimator"])
    assert back["rmse_rel"].tolist() == pytest.approx(left["rmse_rel"].tolist(), rel=1e-5, nan_ok=True)
    shown.page.get_by_label("Find").fill("numpy")
    assert shown.do("shown.length") == len(left.query("backend == 'numpy'"))
    shown.page.get_by_role("button", name="Show all").click()
    assert shown.do("location.hash") == ""
    for anchor, count in ((link.partition("#")[2], len(left)), ("nonsense=%E0%A4%A", len(rows))):
        shown.do(f"location.hash = {json.dumps('#' + anchor)}")
        shown.wait(f"document.getElementById('shown').textContent.includes('{count} of {len(rows)} cells')")


def test_table_sorts_both_ways_and_has_missing_values_last(shown):
    place = shown.do("page.columns.findIndex((c) => c.name === 'rmse_rel')")
    button = f"document.querySelectorAll('#table thead button')[{place}]"
    shown.do("state.limit = 1e6")
    for order in ("ascending", "descending"):
        shown.do(f"{button}.click()")
        assert shown.do(f"{button}.closest('th').ariaSort") == order
        read = shown.do(
            f"[...document.querySelectorAll('#table tbody tr')].map((line) => line.cells[{place}].textContent)"
        )
        numbers = [float(text) for text in read if text != "-"]
        assert len(read) == len(small_rows())
        assert len(numbers) == int((small_rows()["status"] == "ok").sum())
        assert numbers == sorted(numbers, reverse=order == "descending")
        assert set(read[len(numbers) :]) <= {"-"}


def test_a_row_selects_the_cell_and_shows_its_command(shown):
    shown.do("document.querySelector('#table tbody tr').focus()")
    shown.press("ArrowDown")
    shown.press("Enter")
    assert shown.do("state.selected") == shown.do("Number(document.querySelectorAll('#table tbody tr')[1].dataset.row)")
    assert shown.do("document.getElementById('command').textContent") == "python -m bench name=one_cell a=1"
    assert "null" not in shown.do("document.getElementById('cell').innerText")
    shown.do("document.querySelector('#cell button').click()")
    assert shown.do("document.getElementById('cell').hidden")


def test_keyboard_reaches_filters_headings_and_rows(shown):
    shown.do("document.querySelector('.skip').focus()")
    active = "document.activeElement"
    reached = set()
    for _ in range(60):
        shown.press("Tab")
        reached.add(shown.do(f"{active}.closest('#filters, #find, #csv, thead, tbody')?.tagName"))
        assert shown.do(f"{active}.matches(':focus-visible')")
        assert float(shown.do(f"getComputedStyle({active}).outlineWidth").removesuffix("px")) >= 2
    assert {"BUTTON", "DIV", "INPUT", "THEAD", "TBODY"} <= reached


@pytest.mark.parametrize("dark", [False, True])
def test_page_and_drawings_follow_the_theme_of_the_system(shown, dark):
    shown.size(*WIDE, dark)
    ground = shown.do("getComputedStyle(document.body).backgroundColor")
    assert ground == ("rgb(20, 23, 26)" if dark else "rgb(255, 255, 255)")
    assert ("invert" in shown.do(f"getComputedStyle({SVG}).filter")) == dark


def test_a_drawing_says_what_it_is_has_texts_of_12_pixels_and_shares_no_id(shown):
    assert shown.do(f"[{SVG}.role, {SVG}.ariaLabel]") == [
        "img",
        "How does the error of one estimate depend on stiffness?",
    ]
    texts = "[...document.querySelectorAll('.drawing:not(.narrow) text')].filter((one) => !one.querySelector('tspan'))"
    sizes = f"{texts}.map((one) => parseFloat(getComputedStyle(one).fontSize) * Math.hypot(one.getScreenCTM().c, one.getScreenCTM().d))"
    assert min(shown.do(sizes)) >= 12
    ids = shown.do("[...document.querySelectorAll('[id]')].map((one) => one.id)")
    assert len(set(ids)) == len(ids)
    targets = "[...document.querySelectorAll('.drawing use')].map((one) => one.getAttribute('xlink:href').slice(1))"
    assert shown.do(f"{targets}.every((id) => document.getElementById(id))")


def test_on_a_phone_a_chart_is_one_panel_wide_with_texts_of_11_pixels(browser, tmp_path):
    """A chart of three panels was two columns wide, and scrolled sideways."""
    frame = pd.DataFrame({"x": [1.0, 2.0, 3.0] * 3, "panel": [*"aaabbbccc"]})
    chart = Chart("three", frame, [Column("x")], [Column("x")], panel="panel")
    made, rows = experiment(), small_rows()
    browser.size(390, 3000)
    browser.show(tmp_path, helpers.page(made, rows, replace(views_of(made, rows), charts=[chart])))
    boxes = (
        "[...document.querySelectorAll('.drawing')].map((one) => [one.className, one.getBoundingClientRect().width])"
    )
    widths = dict(browser.do(boxes))
    assert widths["drawing wide"] == 0 < widths["drawing narrow"] <= 390
    titles = "[...document.querySelectorAll('.drawing.narrow text')].filter((one) => 'abc'.includes(one.textContent))"
    places = browser.do(
        f"{titles}.map((one) => [one.getBoundingClientRect().x, parseFloat(getComputedStyle(one).fontSize) * one.getScreenCTM().a])"
    )
    assert len({round(x) for x, _ in places}) == 1
    assert min(size for _, size in places) >= 11
    browser.size(*WIDE)


def test_texts_of_a_drawing_are_as_wide_as_they_were_measured(shown):
    """In another font labels would overlap."""
    longest = "[...document.querySelectorAll('.drawing:not(.narrow) text')].map((one) => [one.textContent, one.getBBox().width])"
    text, width = max(shown.do(longest), key=lambda one: one[1] if "stiffness" in one[0] else 0)
    assert width / 72 == pytest.approx(width_in_inches(text), rel=0.03)


def test_hostile_names_are_shown_as_they_are_and_do_nothing(browser, tmp_path):
    rows = small_rows(estimators=("fobg", "reinforce"), backends=("jax",))
    hostile = [rows.assign(scene=name, estimator=name, reason=name, key=rows["key"] + name) for name in HOSTILE]
    every, made = pd.concat([rows, *hostile], ignore_index=True), experiment(name=HOSTILE[0])
    frame = pd.DataFrame({"x": [1.0, 2.0, 3.0] * len(HOSTILE), "name": sorted(HOSTILE * 3)})
    chart = Chart("hostile", frame, [Column("x")], [Column("x")], series="name", panel="name", subtitle=HOSTILE[1])
    views = replace(views_of(made, every), charts=[chart])
    browser.show(tmp_path, helpers.page(made, every, views))
    browser.do("select(page.count - 1)")
    assert browser.do("window.hacked === undefined")
    texts = browser.do("document.body.innerText")
    assert all(name in texts for name in HOSTILE)
    assert browser.do("document.querySelectorAll('img, .drawing b, td b').length") == 0
    legend = browser.do("[...document.querySelectorAll('.drawing text')].map((one) => one.textContent)")
    assert set(HOSTILE) <= set(legend)
    assert browser.said == browser.requests == []
