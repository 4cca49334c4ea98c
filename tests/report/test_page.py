"""The page of an experiment: what it says, that it stays literal, and what it does in a browser without a network."""

from __future__ import annotations

import html
import io
import json
import math
import re
import shlex
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pandas as pd
import pytest
from helpers import experiment, row, small_rows, stiffness_rows, table

from bench import cli
from bench.experiment.columns import Column, Columns
from bench.experiment.study import Study
from bench.experiment.views import Chart, Mark, Style, Views
from bench.model import registry
from bench.report.draw import series_styles
from bench.report.finish import views_of
from bench.report.web import document
from bench.report.web.data import encode
from bench.run.store import Store
from bench.studies.bias_variance.charts import with_plotted_columns
from bench.studies.bias_variance.columns import COLUMNS
from bench.studies.bias_variance.costs import with_gradient_cost

HOSTILE = (
    "<script>window.hacked=1</script>",
    '<img src=x onerror="window.hacked=1">',
    "</script><b>bold</b>",
    "{{data}} & $x$",
)
"""Names that would do something if they were taken for HTML, or for a part of the page's template."""


CLOUD = "charts.find((c) => c.table === 'error_against_time')"
ALONG = "charts.find((c) => c.table.startsWith('bias_variance_'))"
"""The charts of errors against time and along an axis, in the page's script."""


def page(rows, study=None, **given):
    """The page of made-up rows."""
    made = experiment(**given)
    if study is not None:
        made = replace(made, study=study, columns=study.columns)
    return document.assemble(made, rows, views_of(made, rows), [["a=1"]] * len(rows), {})


def data_of(text):
    return json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])


def column(data, name, of="rows"):
    found = data["tables"][of][name]
    return [found["values"][i] for i in found["index"]] if isinstance(found, dict) else found


def finding(text):
    found = re.search(r'id="headline">(.*?)</p>', text, re.DOTALL)[1]
    return html.unescape(re.sub(r"<[^>]+>", "; ", found))


# ------------------------------------------------------------------------------------------------------- contents


def test_the_page_shows_what_to_use_where():
    given = {"scene": "one", "estimator": "good", "rmse_rel": 0.1}
    rows = [row(**given | {"stiffness": k}) for k in (10.0, 100.0, 1000.0)]
    rows += [row(**given | {"stiffness": k, "estimator": "other", "rmse_rel": 0.5}) for k in (10.0, 100.0)]
    rows += [row(**given | {"stiffness": 1000.0, "estimator": "other", "rmse_rel": 0.04})]
    rows = table(rows)
    text = page(rows, sweep={"stiffness": [10.0, 100.0, 1000.0]}, marks={})
    assert "stiffness 10, 100<" in text


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


def test_numbers_keep_six_digits_and_missing_ones_are_null():
    assert encode(pd.Series([1.23456789, np.nan, np.inf, 3.0, 1e-30])) == [1.23457, None, None, 3, 1e-30]


def test_a_bias_that_cannot_be_told_from_0_is_drawn_as_its_upper_limit():
    rows = table([row(stiffness=k, bias=0.0, bias_low=0.0, bias_high=0.8, reference_norm=4.0) for k in (1.0, 2.0)])
    found = data_of(page(rows))
    assert column(found, "bias_limit") == [1, 1]
    assert column(found, "bias_shown") == pytest.approx([0.2, 0.2])


@pytest.mark.slow
def test_page_holds_plotly_once_asks_for_nothing_and_stays_small():
    text = page(small_rows())
    assert len(text) < 6e6
    assert text.count("window.Plotly = Plotly") == 1
    assert not re.search(r'(src|href)="(?!#)', text.partition('id="data"')[0])
    assert "default-src 'none'" in text


RUN = (
    "name=mine", "scenes=[pushing]", "scene.pushing.horizon=5", "contacts=[penalty,complementarity]", "backends=[numpy]",
    "estimators=[reinforce,randomized_smoothing]", "sweep.stiffness=[1e2,1e3]", "samples=8", "repeats=4",
    "reference.samples=4096",
)  # fmt: skip


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """A small run through the command line: the directory of its results."""
    directory = tmp_path_factory.mktemp("results")
    assert cli.main([*RUN, "workers=0", f"results_dir={directory}"]) == 0
    return directory


def stored(directory, name):
    return Store(directory / name, COLUMNS).load().set_index("key")


@pytest.mark.slow
def test_command_in_the_page_gives_the_same_numbers_of_that_cell_alone(ran, tmp_path):
    found = data_of((ran / "mine" / "report.html").read_text())
    place = column(found, "status").index("ok")
    words = [c["values"][c["index"][place]] for c in found["command"]["words"]]
    told = shlex.split(" ".join([found["command"]["head"], *filter(None, words)]))
    assert cli.main([*told[3:], "workers=0", f"results_dir={tmp_path}"]) == 0
    alone = stored(tmp_path, "one_cell")
    assert len(alone) == 1
    before = stored(ran, "mine").loc[alone.index[0]]
    for name in ("bias", "variance", "rmse"):
        assert alone[name].iloc[0] == before[name]


@pytest.mark.slow
def test_report_writes_the_page_again_with_machine_and_versions(ran):
    path = ran / "mine" / "report.html"
    path.unlink()
    assert cli.main(["report", *RUN, f"results_dir={ran}"]) == 0
    text = path.read_text()
    assert "numpy" in text.partition("Configuration")[0].partition('id="made"')[2]


# -------------------------------------------------------------------------------------------------------- browser

MARKS = "document.querySelectorAll('.scatterlayer .trace .point').length"
SETTLED = "settled()"
WIDE = (1200, 3000)


@pytest.fixture(scope="module")
def opened(browser, tmp_path_factory):
    """The page of a few rows, opened once."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(page(small_rows()))
    browser.size(*WIDE)
    browser.open(path)
    return browser


@pytest.fixture
def shown(opened):
    """That page with nothing filtered, sorted or selected; it never complains and never asks for anything."""
    opened.size(*WIDE)
    opened.do("document.getElementById('clear').click(); state.sort = null; applyTheme('auto'); select(-1)")
    opened.do(SETTLED)
    yield opened
    assert opened.said == []
    assert opened.requests == []


def test_unsteady_times_are_marked(browser, tmp_path):
    rows = table([row(stiffness=k, time_s=0.01, time_iqr_s=spread) for k, spread in ((1.0, 1e-4), (2.0, 5e-3))])
    path = tmp_path / "report.html"
    path.write_text(page(rows))
    browser.open(path)
    assert browser.do("[0, 1].map((i) => shownAs(page.columns.find((c) => c.name === 'time_s'), i))") == [
        "10 ms",
        "10 ms !",
    ]


def test_errors_time_and_status_are_in_sight_on_a_laptop(browser, tmp_path):
    path = tmp_path / "report.html"
    path.write_text(page(stiffness_rows()))
    browser.size(1280, 900)
    browser.open(path)
    heads = "[...document.querySelectorAll('#table th')]"
    for name in ("rel. RMSE", "rel. bias", "time", "status"):
        right = browser.do(f"{heads}.find((h) => h.textContent.trim() === '{name}').getBoundingClientRect().right")
        assert right <= 1280, name
    browser.size(*WIDE)


def test_what_to_use_where_is_in_sight_as_a_whole_on_a_laptop(browser, tmp_path):
    """Long settings of estimators break; they pushed the last column out of sight."""
    path, long = tmp_path / "report.html", "delta=0.95,gamma=4,sharing=shared,samples=quasi_random,pilot=0.25"
    rows = [
        row(scene=scene, stiffness=k, estimator=e, estimator_params=p, rmse_rel=error)
        for scene in "abcdefgh"
        for k in (1.0, 10.0)
        for e, p, error in (("randomized_smoothing", "", 0.1), ("alpha_order", long, 2.0), ("alpha_order", f"{long},ratio=3", 0.5), ("control_variate", "", 3.0))
    ]  # fmt: skip
    path.write_text(page(table(rows)))
    browser.size(1280, 900)
    browser.open(path)
    wider = "(b => b.scrollWidth - b.clientWidth)(document.querySelector('#answers .scroll'))"
    assert browser.do(wider) <= 0
    assert browser.do("document.querySelectorAll('#answers tr').length") > 8
    higher = "(b => b.scrollHeight - b.clientHeight)(document.querySelector('#answers .scroll'))"
    assert browser.do(higher) <= 0, "every row is visible without scrolling in a box"
    browser.size(*WIDE)


@pytest.mark.slow
def test_print_fills_the_page_with_charts_and_tables_that_fit_it(browser, tmp_path):
    """What is wider than A4 between its margins would make a browser print everything smaller."""
    path = tmp_path / "report.html"
    path.write_text(page(stiffness_rows()))
    browser.size(718, 1000)
    browser.open(path)
    browser.page.emulate_media(media="print")
    browser.do("dispatchEvent(new Event('beforeprint'))")
    assert browser.do("document.documentElement.scrollWidth") <= 718
    widths = "[...document.querySelectorAll('.plot')].map((p) => p.querySelector('.main-svg').getBoundingClientRect().width - p.clientWidth)"
    assert max(map(abs, browser.do(widths))) <= 2
    right = "Math.max(...[...document.querySelectorAll('.panels > div')].map((p) => p.getBoundingClientRect().right))"
    assert browser.do(right) > 0.9 * 680
    browser.do("dispatchEvent(new Event('afterprint'))")
    browser.size(*WIDE)
    assert browser.said == []


@pytest.mark.slow
def test_20000_cells_open_within_three_seconds_of_processor_time_and_are_saved_as_csv(browser, tmp_path):
    rows = stiffness_rows()
    made = views_of(experiment(), rows)
    times = -(-20_000 // len(rows))

    def repeated(frame):
        parts = [frame.assign(row=frame["row"] + i * len(rows)) if "row" in frame else frame for i in range(times)]
        return pd.concat(parts, ignore_index=True)

    charts = [replace(chart, frame=repeated(chart.frame)) for chart in made.charts]
    many = replace(made, charts=charts, rows=None if made.rows is None else repeated(made.rows))
    rows = repeated(rows)
    path = tmp_path / "report.html"
    path.write_text(document.assemble(experiment(), rows, many, [["a=1"]] * len(rows), {}))
    session = browser.page.context.new_cdp_session(browser.page)
    session.send("Performance.enable", {"timeDomain": "threadTicks"})
    browser.size(1280, 900)
    browser.open(path)
    metrics = {one["name"]: one["value"] for one in session.send("Performance.getMetrics")["metrics"]}
    session.detach()
    browser.size(*WIDE)
    assert metrics["TaskDuration"] < 3, "seconds of the main thread"
    with browser.page.expect_download() as download:
        browser.page.click("#csv")
    saved = pd.read_csv(download.value.path())
    assert len(saved) == len(rows) >= 20_000
    assert (
        browser.do("(() => { const started = performance.now(); csv(); return performance.now() - started; })()") < 3000
    )
    assert browser.said == []


def test_backends_are_told_apart_by_name(browser, tmp_path):
    """Beside points stands their backend; at the ends of lines only where an estimator's backends differ."""
    rows = pd.concat(
        [table([row(stiffness=k, backend=name, estimator=estimator, rmse_rel=error, bias=error, bias_low=error / 2, bias_high=2 * error, time_s=time) for k in (1.0, 10.0)])
         for estimator, name, error, time in (("fobg", "one", 0.1, 1e-3), ("fobg", "two", 5.0, 2e-3), ("reinforce", "one", 0.5, 3e-3), ("reinforce", "two", 0.5, 4e-3))],
        ignore_index=True,
    )  # fmt: skip
    path = tmp_path / "report.html"
    path.write_text(page(rows, sweep={"stiffness": [1.0, 10.0]}, marks={}))
    browser.open(path)
    names = "[...%s.panels.querySelectorAll('.plot')].map((p) => p.layout.annotations.map((a) => a.text).filter((t) => /one|two/.test(t)).sort())"
    assert browser.do(names % CLOUD) == [["one", "one", "two", "two"]] * 2
    assert browser.do(names % ALONG) == [["one", "two"]]
    assert browser.said == []


def test_a_browser_draws_a_panel_for_each_stiffness_and_noise(browser, tmp_path):
    """Points of two stiffnesses or noises in one panel would look like scatter."""
    rows = table([
        row(stiffness=k, sigma=s, samples=n, time_s=1e-3 * n, rmse_rel=n**-0.5)
        for k in (10.0, 1000.0) for s in (0.1, 0.3) for n in (16, 64)
    ])  # fmt: skip
    path = tmp_path / "report.html"
    path.write_text(page(rows, sweep={"samples": [16, 64], "stiffness": [10.0, 1000.0], "sigma": [0.1, 0.3]}, marks={}))
    browser.open(path)
    browser.do(SETTLED)
    browser.do("charts.forEach((chart) => drawChart(chart))")
    drawn = browser.do(
        "charts.filter((c) => !c.fill).map((c) => [...c.panels.querySelectorAll('.plot')].map((p) => p.data.filter((d) => d.text)"
        ".reduce((n, d) => n + d.x.length, 0)))"
    )
    assert drawn[browser.do(f"charts.filter((c) => !c.fill).indexOf({CLOUD})")] == [2] * 4, (
        "two sample counts for each stiffness and noise"
    )
    assert all(max(panels, default=0) <= 2 for panels in drawn), drawn
    assert browser.said == []


def test_charts_are_drawn_and_a_filter_takes_points_away(shown):
    rows = small_rows()
    before = shown.do(MARKS)
    assert before >= 2 * int((rows["status"] == "ok").sum())
    shown.do(
        """(() => {
        const box = document.querySelector('#filters details[data-column="estimator"] input[data-value="fobg"]');
        box.checked = false;
        box.dispatchEvent(new Event('change'));
        return settled();
        })()"""
    )
    left = rows[rows["estimator"] != "fobg"]
    assert 2 * int((left["status"] == "ok").sum()) <= shown.do(MARKS) < before
    assert f"{len(left)} of {len(rows)} cells" in shown.do("document.getElementById('shown').textContent")
    shown.do("document.getElementById('clear').click(); settled()")
    assert shown.do(MARKS) == before


def test_filters_stay_in_the_address_and_the_csv_has_what_is_shown(shown, tmp_path):
    rows = small_rows()
    address = shown.do("location.href.split('#')[0]")
    shown.do(
        """(() => {
        const box = document.querySelector('#filters details[data-column="estimator"] input[data-value="fobg"]');
        box.checked = false;
        box.dispatchEvent(new Event('change'));
        return settled();
        })()"""
    )
    link = shown.do("location.href")
    assert link.startswith(f"{address}#estimator=")
    assert "fobg" not in link
    left = rows[rows["estimator"] != "fobg"]
    back = pd.read_csv(io.StringIO(shown.do("csv()")))
    assert len(back) == len(left)
    assert set(back["estimator"]) == set(left["estimator"])
    assert back["rmse_rel"].tolist() == pytest.approx(left["rmse_rel"].tolist(), rel=1e-5, nan_ok=True)
    shown.do("document.getElementById('clear').click(); settled()")
    assert shown.do("location.hash") == ""
    shown.do(
        f"location.hash = {json.dumps('#' + link.partition('#')[2])}; new Promise((done) => setTimeout(done, 200))"
    )
    assert f"{len(left)} of {len(rows)} cells" in shown.do("document.getElementById('shown').textContent")
    shown.do("location.hash = '#nonsense=%E0%A4%A'; new Promise((done) => setTimeout(done, 200))")
    assert f"{len(rows)} of {len(rows)} cells" in shown.do("document.getElementById('shown').textContent")


def test_no_panel_pools_stiffness_or_sigma():
    derived = with_plotted_columns(with_gradient_cost(stiffness_rows()))
    pooled = derived.groupby("problem_")[["stiffness", "sigma"]].nunique()
    assert (pooled == 1).all().all()


def test_number_of_points_in_the_first_chart_is_that_of_the_good_cells(shown):
    drawn = shown.do(
        f"[...{CLOUD}.panels.querySelectorAll('.plot')].flatMap((plot) => plot.data).filter((one) => one.text)"
        ".reduce((count, one) => count + one.x.length, 0)"
    )
    assert drawn == int((small_rows()["status"] == "ok").sum())


def test_time_axis_takes_compilation_and_rollouts(shown):
    values = f"{CLOUD}.panels.querySelector('.plot').data.filter((one) => one.text).flatMap((one) => one.x)"
    times = shown.do(values)
    select = f"{CLOUD}.options.querySelector('select')"
    for place in (1, 2):
        shown.do(f"{select}.value = {place}; {select}.dispatchEvent(new Event('change'))")
        assert min(shown.do(values)) > max(times)
    shown.do(f"{select}.value = 0; {select}.dispatchEvent(new Event('change'))")


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


def test_a_row_and_a_point_select_the_cell_and_show_its_command(shown):
    shown.do("document.querySelector('#table tbody tr').focus()")
    shown.press("ArrowDown")
    shown.press("Enter")
    assert shown.do("state.selected") == shown.do("Number(document.querySelectorAll('#table tbody tr')[1].dataset.row)")
    assert shown.do("document.getElementById('command').textContent") == "python -m bench name=one_cell a=1"
    assert "null" not in shown.do("document.getElementById('cell').innerText")
    shown.do("document.querySelector('#cell button').click(); settled()")
    assert shown.do("document.getElementById('cell').hidden")
    x, y = shown.do(
        """(() => {
        const box = document.querySelector('.scatterlayer .point').getBoundingClientRect();
        return [box.x + box.width / 2, box.y + box.height / 2];
        })()"""
    )
    shown.click(x, y)
    shown.wait("state.selected >= 0 && !document.getElementById('cell').hidden", 10)


def test_keyboard_reaches_theme_filters_headings_and_rows(shown):
    shown.do("document.activeElement.blur(); window.getSelection().collapse(document.body, 0)")
    active = "document.activeElement"
    reached = set()
    for _ in range(60):
        shown.press("Tab")
        reached.add(shown.do(f"{active}.closest('#theme, #filters, #find, .options, thead, tbody, a')?.tagName"))
        assert shown.do(f"{active}.matches(':focus-visible')")
        assert float(shown.do(f"getComputedStyle({active}).outlineWidth").removesuffix("px")) >= 2
    assert {"A", "BUTTON", "DIV", "INPUT", "THEAD", "TBODY"} <= reached


@pytest.mark.parametrize("dark", [False, True])
def test_colours_follow_the_system_and_the_button(shown, dark):
    ground = "getComputedStyle(document.body).backgroundColor"
    light_ground, dark_ground = "rgb(255, 255, 255)", "rgb(20, 23, 26)"
    shown.size(*WIDE, dark)
    assert shown.do(ground) == (dark_ground if dark else light_ground)
    shown.do("document.getElementById('theme').click()")
    assert shown.do(ground) == dark_ground
    shown.do("document.getElementById('theme').click()")
    assert shown.do(ground) == light_ground


def test_an_estimator_has_one_colour_in_every_chart(shown):
    found = shown.do(
        "[...document.querySelectorAll('.plot')].flatMap((plot) => plot.data).filter((one) => one.text)"
        ".map((one) => [reader('rows', 'estimator')(one.customdata[0]), one.marker.color])"
    )
    assert {name for name, _ in found} == set(small_rows()["estimator"])
    assert len({tuple(pair) for pair in found}) == len({name for name, _ in found})


def test_hostile_names_are_shown_as_they_are_and_do_nothing(browser, tmp_path):
    rows = small_rows(estimators=("fobg", "reinforce"), backends=("jax",))
    hostile = [rows.assign(scene=name, estimator=name, reason=name, key=rows["key"] + name) for name in HOSTILE]
    path = tmp_path / "report.html"
    path.write_text(page(pd.concat([rows, *hostile], ignore_index=True), name=HOSTILE[0]))
    browser.open(path)
    browser.do("select(rowCount - 1)")
    assert browser.do("window.hacked === undefined")
    texts = browser.do("document.body.innerText")
    assert all(name in texts for name in HOSTILE)
    assert browser.do("document.querySelectorAll('img, .panels b, td b').length") == 0
    assert browser.said == browser.requests == []


def test_a_chart_may_have_names_on_its_axis_and_lines_of_no_cell(browser, tmp_path):
    """Dots in the order of the table, joined, hollow only where limits; a shaded range; no cell to select or filter."""
    frame = pd.DataFrame({
        "name": ["zebra", "zebra", "<b>ant</b>", "<b>ant</b>"], "size": [1.0, 10.0, 2.0, 100.0], "low": [0.5, 5.0, 1.0, 50.0],
        "high": [2.0, 20.0, 4.0, 200.0], "is_limit": [False, False, True, False], "kind": list("abab"), "row": -1,
    })  # fmt: skip
    size = Column("size", low="low", high="high", limit="is_limit", log=True)
    chart = Chart(
        "sizes", frame, [size], [Column("name", kind="text")], "dots", series="kind", join=True, text="text",
        marks=[Mark("large", 50.0, math.inf), Mark("one", 1.0)],
    )  # fmt: skip
    rows = small_rows()
    views = Views(charts=[chart])
    path = tmp_path / "report.html"
    path.write_text(document.assemble(experiment(), rows, views, [["a=1"]] * len(rows), {}))
    browser.open(path)
    plot = "document.querySelector('.plot')"
    assert browser.do(f"{plot}.data.filter((one) => one.text).map((one) => [one.x, one.error_x.array])") == [
        [[1, 2], [1, 0]], [[10, 100], [10, 100]],
    ]  # fmt: skip
    assert browser.do(f"{plot}.data.filter((one) => one.text).flatMap((one) => one.marker.symbol)") == [
        "circle", "circle-open", "square",
    ]  # fmt: skip
    assert browser.do(f"{plot}.data.filter((one) => one.mode === 'lines').map((one) => one.x)") == [[1, 10], [2, 100]]
    texts = browser.do(
        f"[...{plot}.querySelectorAll('.ytick text')].map((one) => [one.textContent, one.getBoundingClientRect().top])"
    )
    assert [text for text, top in sorted(texts, key=lambda one: one[1])] == ["zebra", "<b>ant</b>"]
    assert browser.do(f"{plot}.layout.shapes.map((one) => one.type).sort()") == ["line", "rect"]
    assert browser.do(f"{plot}.layout.annotations.map((one) => one.text)") == ["large", "one"]
    browser.do("state.find = 'nothing has this'; refresh(); settled()")
    assert browser.do(f"{plot}.data.filter((one) => one.text).length") == 2
    assert browser.said == []


def test_points_without_a_value_are_crosses_at_the_edge_and_the_dots_of_a_row_do_not_overlap(browser, tmp_path):
    """The faults: a row that nobody reaches was left out where the text spoke of crosses, and a row's dots hid each other."""
    frame = pd.DataFrame({
        "problem": ["hard", "hard", "easy", "easy"], "kind": list("abab"), "cost": [np.nan, np.nan, 10.0, 10.0],
        "missed": [True, True, False, False], "error": [1.0, 2.0, 3.0, 4.0],
    })  # fmt: skip
    cost = Column("cost", log=True)
    dots = Chart("reached", frame, [cost], [Column("problem", kind="text")], "dots", series="kind", failed="missed")
    lines = Chart("errors", frame, [Column("error")], [cost], series="kind", failed="missed")
    rows = small_rows()
    path = tmp_path / "report.html"
    views = Views(charts=[dots, lines])
    path.write_text(document.assemble(experiment(), rows, views, [["a=1"]] * len(rows), {}))
    browser.open(path)

    def drawn(chart, symbol):
        browser.do(f"drawChart(charts[{chart}])")
        plot = f"charts[{chart}].panels.querySelector('.plot')"
        is_cross = "(one) => one.marker && one.marker.symbol === 'x-thin'"
        found = f"{plot}.data.filter((one) => one.text && ({is_cross})(one) === {symbol}).map((one) => [one.x[0], one.y[0]])"
        return browser.do(found), plot

    crosses, plot = drawn(0, "true")
    points, _ = drawn(0, "false")
    assert [x for x, _ in points] == [10, 10]
    assert all(x > 10 for x, _ in crosses)
    heights = [y for _, y in [*crosses, *points]]
    assert len(set(heights)) == 4
    assert [round(y) for y in heights] == [0, 0, 1, 1]  # "hard" is the first row, at the top
    assert browser.do(f"{plot}.layout.yaxis.ticktext") == ["hard", "easy"]
    crosses, _ = drawn(1, "true")
    assert [x for x, _ in crosses] == [1, 2]
    assert all(y > 10 for _, y in crosses)
    assert browser.said == []


def test_charts_have_their_own_looks_and_panels_their_own_scales_where_print_has_them(browser, tmp_path):
    """The faults: a name had one colour on the whole page, so that two series of a chart could share it, and one scale."""
    frame = pd.DataFrame({
        "x": [1.0, 2.0] * 4, "y": [0.0, 1.0, 0.2, 0.8, 0.0, 100.0, 20.0, 80.0], "panel": ["small"] * 4 + ["large"] * 4,
        "name": ["one", "one", "two", "two"] * 2,
    })  # fmt: skip
    x, y = Column("x", log=False), Column("y", log=False)
    both = Chart("both", frame, [x], [y], series="name", panel="panel", own_scales=True)
    alone = Chart("alone", frame[frame["name"] == "two"], [x], [y], series="name", panel="panel")
    rows = small_rows()
    path = tmp_path / "report.html"
    views = Views(charts=[both, alone])
    path.write_text(document.assemble(experiment(), rows, views, [["a=1"]] * len(rows), {}))
    browser.open(path)
    for k, chart in enumerate((both, alone)):
        plots = f"[...charts[{k}].panels.querySelectorAll('.plot')]"
        drawn = browser.do(f"{plots}.flatMap((plot) => plot.data).map((one) => one.line.color)")
        printed = [style.colour.lower() for style in series_styles(chart).values()]
        assert drawn == printed * 2
        ends = browser.do(f"{plots}.map((plot) => plot.layout.yaxis.range[1])")
        assert ends == pytest.approx([1.08, 108.0] if chart.own_scales else [86.4, 86.4], rel=0.01)
    assert browser.said == []


def test_cells_of_a_map_may_have_colours_and_texts_of_their_own(browser, tmp_path):
    frame = pd.DataFrame({
        "x": ["b", "a"] * 15, "y": [f"line {i // 2}" for i in range(30)], "value": [1.5, 900.0] * 15, "text": ["1.5", ">9"] * 15,
    })  # fmt: skip
    x, y = Column("x", kind="text"), Column("y", kind="text")
    chart = Chart("map", frame, [x], [y], "grid", value="value", cell="text")
    rows = small_rows()
    path = tmp_path / "report.html"
    views = Views(charts=[chart])
    path.write_text(document.assemble(experiment(), rows, views, [["a=1"]] * len(rows), {}))
    browser.open(path)
    shown = browser.do(
        "[...document.querySelectorAll('.plot .textpoint text')].map((one) => [one.textContent, getComputedStyle(one).fill])"
    )
    assert sorted(map(tuple, shown)) == [("1.5", "rgb(0, 0, 0)")] * 15 + [(">9", "rgb(255, 255, 255)")] * 15
    assert browser.do("document.querySelector('.plot').data[0].x") == ["b", "a"]
    assert browser.do("document.querySelector('.plot').getBoundingClientRect().height") == 60 + 24 * 15
    assert browser.said == []


def test_cells_of_a_map_have_the_colours_of_its_legend(browser, tmp_path):
    """Also where a style names its colour as Matplotlib does: one such colour made all cells those of Plotly."""
    frame = pd.DataFrame({"x": ["a", "b", "c"] * 2, "y": ["1"] * 3 + ["2"] * 3, "level": ["good", "bad", "none"] * 2})
    frame = frame.assign(cell="12.34")
    styles = {
        "good": Style("#009E73", letter="+"),
        "bad": Style("tab:red", letter="x"),
        "none": Style("0.85", letter="-"),
    }
    x, y = Column("x", kind="text"), Column("y", kind="text")
    chart = Chart("map", frame, [x], [y], "grid", level="level", cell="cell", styles=styles)
    rows, path = small_rows(), tmp_path / "report.html"
    path.write_text(document.assemble(experiment(), rows, Views(charts=[chart]), [["a=1"]] * len(rows), {}))
    browser.open(path)
    legend = browser.do("[...document.querySelectorAll('b.level')].map((one) => one.style.background)")
    assert legend == ["rgb(0, 158, 115)", "rgb(214, 39, 40)", "rgb(217, 217, 217)"]
    cells = browser.do("document.querySelector('.plot').data[0].colorscale.map((one) => one[1])")
    assert sorted(set(cells)) == ["#009e73", "#d62728", "#d9d9d9"]
    assert browser.do("document.querySelector('.plot').data[1].text") == ["12.34"] * 6
    assert browser.do("NARROWEST * 3") < browser.do("document.querySelector('.plot').clientWidth")


@dataclass(frozen=True)
class Unknown(Study):
    """A study without a page of its own."""

    name = "unknown"
    columns: ClassVar[Columns] = COLUMNS

    def measure(self, cell, session):
        """Nothing."""
        return {"status": "ok"}


STUDIES = {name: entry.plugin for name, entry in registry.entries()["studies"].items() if name != "bias_variance"}


@pytest.mark.parametrize("study", [*STUDIES.values(), Unknown], ids=[*STUDIES, "unknown"])
def test_page_of_every_other_study_says_why_nothing_ran(study):
    blank = study.columns.blank() | {"experiment": "made_up", "scene": "pushing", "estimator": "fobg", "seed": 0.0}
    rows = [blank | {"key": status, "status": status, "reason": "no reason"} for status in ("unsupported", "error")]
    found = data_of(page(study.columns.typed(pd.DataFrame(rows)), study=study()))
    assert column(found, "reason") == ["no reason", "no reason"]
