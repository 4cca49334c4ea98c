"""The site: every document and result has a page, the pages agree with the stored results, and it works offline."""

import json
import re
import shutil
import subprocess
from unittest import mock

import pytest

from bench.model import registry
from docs import results, website

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
HOSTILE = "<meta http-equiv=refresh content=0> [a](b) `c` *d* {math}`e` | <div style='position:fixed'>"


@pytest.fixture(scope="module")
def pages():
    """The Markdown text of every page, by name."""
    return website.sources()


@pytest.mark.slow
def test_every_page_is_once_in_the_navigation_of_five_entries(pages):
    listed = [
        name
        for text in pages.values()
        for block in re.findall(r"```{toctree}\n(.*?)```", text, re.DOTALL)
        for name in re.findall(r"^(?:.* <)?([\w/.-]+)>?$", block.replace(":hidden:", ""), re.MULTILINE)
    ]
    assert sorted(listed) == sorted(set(pages) - {"index"})
    block = pages["index"].partition("```{toctree}")[2]
    assert len(re.findall(r"^[A-Z].* <|^[a-z]+$", block, re.MULTILINE)) == len(website.SECTIONS) == 5


@pytest.mark.slow
def test_every_experiment_with_results_has_a_page(pages):
    for entry in results.entries_of(results.STANDARD):
        assert (entry.page in pages) == entry.has_results


@pytest.mark.slow
def test_every_claim_with_a_result_has_a_page(pages):
    names = {path.stem for path in (results.STANDARD / "claims").glob("[A-Z]*.json")}
    assert {name for name in pages if name.startswith("claim/")} == {f"claim/{name}" for name in names}
    assert website.expand("claim/*", ["claim/C10", "claim/L1", "claim/C2"]) == ["claim/C2", "claim/C10", "claim/L1"]


@pytest.mark.slow
def test_every_estimator_has_a_page_with_its_source(pages):
    for name, entry in registry.entries()["estimators"].items():
        if not entry.plugin.__module__.startswith("bench.plugins."):
            continue  # registered by another test
        page = pages[f"estimator/{name}"]
        assert "## Where it wins and fails" in page
        for year in re.findall(r"et al\. (\d{4})", entry.plugin.__doc__):
            assert year in page.partition("## Source")[2].partition("\n## ")[0], (name, year)


def entry(folder, text):
    (folder / "answer.json").write_text(json.dumps({"question": text, "answer": text, "chart": "../x"}))
    return results.entry_of("quick", text, folder)


def test_answers_are_text(tmp_path):
    from markdown_it import MarkdownIt

    page = website.experiment_page(entry(tmp_path, HOSTILE))
    html = MarkdownIt("commonmark").render(page)
    assert "<meta" not in html
    assert "<div" not in html
    assert 'href="b"' not in html
    assert "<em>" not in html


def test_an_experiment_without_results_has_its_question(tmp_path):
    found = results.entry_of("quick", "Why?", tmp_path)
    assert found.question == "Why?"
    assert not found.answer
    assert not found.has_results


@pytest.mark.slow
def test_answers_are_carried_by_the_stored_tables():
    """Conditions in an answer hold, and the stored text is that of today's tables; an answer has two sentences at most."""
    for name, experiment in results.loaded(results.STANDARD).items():
        stored = experiment.directory / "answer.json"
        if experiment.answer:
            text = results.answer_of(name)
            assert json.loads(stored.read_text())["answer"] == text, name
            assert len(re.findall(r"\.(?: [A-Z]|$)", text)) <= 2, name
            assert ";" not in text
        elif stored.exists():
            assert not json.loads(stored.read_text())["answer"], name


# --------------------------------------------------------------------------------------------------- the built site


@pytest.fixture(scope="module")
def site(pages, tmp_path_factory):
    """The folder of the built site."""
    with mock.patch.object(website, "sources", return_value=pages):
        return website.build(tmp_path_factory.mktemp("site")).parent


def dom(page, query=""):
    """The page as Chromium renders it from disk, offline."""
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=10000", "--dump-dom"]
    done = subprocess.run([*command, page.as_uri() + query], capture_output=True, text=True, timeout=120)
    return done.stdout


@pytest.mark.slow
def test_site_needs_no_network(site):
    for page in site.rglob("*.html"):
        assert not re.search(r"<(?:script|link|img)[^>]*(?:src|href)=\"(?:https?:)?//", page.read_text()), page


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_search_works_from_disk(site):
    assert 'href="estimator/reinforce.html' in dom(site / "search.html", "?q=leave_one_out")
