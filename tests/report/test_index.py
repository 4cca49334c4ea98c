"""The page over all experiments of a folder: each is there with its state, literally, and it opens in a browser."""

import json
import re

import pytest
from helpers import failed, row, table
from PIL import Image

from bench import cli
from bench.report import index

HOSTILE = "<script>window.hacked = 1</script>"
BANNER = '<b style="position:fixed;inset:0">banner</b><meta http-equiv="refresh" content="0;url=about:blank#gone"><style>h1{display:none}</style>'
"""Markup that would act without a script: it leaves the page, covers it, and hides its heading."""


@pytest.fixture
def folder(tmp_path):
    """Four experiments: with page, answer, a chart and a failure; without rows; with broken rows; only an answer."""
    rows = table([row(), failed("error", "it broke", seed=1), failed("unsupported", "cannot work", seed=2)])
    for name in ("good", "nested/bare", "broken", "published#1"):
        (tmp_path / name).mkdir(parents=True)
        record = {"experiment": name, "question": HOSTILE, "counts": {"ok": 7}, "git_commit": "0123456789abcdef"}
        (tmp_path / name / "run.json").write_text(json.dumps(record))
    (tmp_path / "published#1" / "run.json").unlink()
    rows.to_parquet(tmp_path / "good" / "rows.parquet")
    for name in ("good", "published#1"):
        answer = {"experiment": name, "question": "why?", "answer": "use fobg < 3 & more", "chart": "second"}
        (tmp_path / name / "answer.json").write_text(json.dumps(answer))
        for stem in ("first", "second"):
            Image.new("RGB", (40, 30), "red").save(tmp_path / name / f"{stem}.png")
    (tmp_path / "good" / "report.html").write_text(f'<p class="finding" id="finding">{BANNER}</p>')
    (tmp_path / "broken" / "rows.parquet").write_text("not Parquet")
    return tmp_path


def card(text, name):
    """The article of an experiment."""
    return next(part for part in text.split("<article") if f"<h2>{name}</h2>" in part)


def test_every_experiment_is_there_with_its_state_and_answer(folder):
    assert cli.main(["index", str(folder)]) == 0
    text = (folder / "index.html").read_text()
    assert text.count("<article") == 4
    good = card(text, "good")
    assert 'href="good/report.html"' in good
    assert "use fobg &lt; 3 &amp; more</p>" in good
    assert 'src="good/second.png"' in good
    assert '<span class="bad">1 error</span>' in good
    assert "<span>1 unsupported</span>" in good
    assert "<span>7 ok</span>" in card(text, "nested/bare")
    assert "rows.parquet cannot be read" in card(text, "broken")
    assert HOSTILE not in text


def test_the_first_screen_is_the_questions_with_links_to_their_experiments(folder):
    text = index.write(folder).read_text()
    first, cards = text[: text.index("<main")], text[text.index("<main") :]
    assert first.count("<li>") == 2, "one per question"
    for link in re.findall(r'<a href="#(e\d+)">', first):
        assert f'id="{link}"' in cards


def test_an_answer_is_shown_without_a_page_and_its_chart_is_one_click_away(folder):
    """As in a fresh clone, where no page has been written."""
    (folder / "good" / "report.html").unlink()
    text = index.write(folder).read_text()
    good = card(text, "good")
    assert "use fobg &lt; 3 &amp; more</p>" in good
    assert good.count('class="button"') == 1
    assert 'href="good/second.png" aria-label="Open the chart of good"' in good
    assert f"results_dir={folder}" in text
    published = card(text, "published#1")
    assert 'src="published%231/second.png"' in published


@pytest.mark.parametrize(
    "content",
    [
        "[]",
        "nonsense",
        "[" * 100_000,
        '{"answer": ["text"]}',
        '{"experiment": 3, "question": [], "answer": [3], "chart": {}}',
        '{"chart": "../../secret"}',
    ],
)
def test_answers_of_other_types_are_left_out(content, folder):
    (folder / "good" / "answer.json").write_text(content)
    text = index.write(folder).read_text()
    good = card(text, "good")
    assert 'src="good/first.png"' in good, "the first chart"
    assert 'class="answer"' not in good
    assert "secret" not in text
    assert HOSTILE not in text


def test_every_text_is_literal_and_nothing_is_taken_from_a_foreign_page(folder, browser):
    browser.open(index.write(folder))
    count = "Promise.all([...document.images].map((one) => one.decode())).then(() => document.images.length)"
    assert (browser.do(count), browser.page.locator(".button").count()) == (2, 2)
    assert "banner" not in browser.do("document.documentElement.textContent")
    for name in ("run", "answer"):
        texts = {"experiment": BANNER, "question": BANNER, "answer": BANNER, "chart": BANNER, "finished": BANNER}
        record = texts | {"git_commit": BANNER, "counts": {BANNER: BANNER}}
        (folder / "nested" / "bare" / f"{name}.json").write_text(json.dumps(record))
    (folder / "nested" / "bare" / f"{BANNER.replace('/', '')}.csv").write_text("a")
    browser.open(index.write(folder))
    browser.do("new Promise((done) => setTimeout(done, 300))")
    assert browser.page.url.endswith("index.html"), "a refresh left the page"
    assert browser.do("document.body.innerText").count(BANNER[:30]) >= 4
    assert browser.do("document.querySelectorAll('main meta, main style, main b, [style]').length") == 0
    assert browser.do("document.querySelector('h1').checkVisibility() && window.hacked === undefined")
    assert browser.said == browser.requests == []
