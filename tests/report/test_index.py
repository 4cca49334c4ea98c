"""The page over all experiments of a folder: each is there with its state, literally, and it opens in a browser."""

from __future__ import annotations

import json

import pytest
from helpers import failed, row, table

from bench import cli
from bench.report import index

HOSTILE = "<script>window.hacked = 1</script>"


@pytest.fixture
def folder(tmp_path):
    """Three experiments: one with a page and a failure, one without rows, one whose rows are broken."""
    rows = table([row(), failed("error", "it broke", seed=1), failed("unsupported", "cannot work", seed=2)])
    for name in ("good", "nested/bare", "broken"):
        (tmp_path / name).mkdir(parents=True)
        record = {"experiment": name, "question": HOSTILE, "counts": {"ok": 7}, "git_commit": "0123456789abcdef"}
        (tmp_path / name / "run.json").write_text(json.dumps(record))
    rows.to_parquet(tmp_path / "good" / "rows.parquet")
    (tmp_path / "good" / "report.html").write_text(
        '<p class="finding" id="finding"><span>bad</span><span>use <b>fobg</b> &lt; 3</span></p>'
    )
    (tmp_path / "broken" / "rows.parquet").write_text("not Parquet")
    return tmp_path


def test_every_experiment_is_there_with_its_state(folder):
    assert cli.main(["index", str(folder)]) == 0
    text = (folder / "index.html").read_text()
    assert text.count("<article>") == 3
    assert 'href="good/report.html"' in text
    assert "<p>bad; use <b>fobg</b> &lt; 3</p>" in text
    assert "3 cells" in text
    assert "<span class=bad>1 error</span>" in text
    assert "<span>1 unsupported</span>" in text
    assert "7 cells: <span>7 ok</span>" in text
    assert "rows.parquet cannot be read" in text
    assert HOSTILE not in text


@pytest.mark.parametrize(("words", "said"), [(["nowhere"], "is not a folder"), (["."], "no experiments"), (["a", "b"], "name one folder")])  # fmt: skip
def test_bad_input_is_refused(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["index", *words]) == 2
    assert said in capsys.readouterr().err


def test_the_index_opens_without_a_complaint(folder, browser):
    browser.open(index.write(folder))
    assert browser.do("document.querySelectorAll('article').length === 3")
    assert browser.do("window.hacked === undefined")
    assert browser.said == browser.requests == []
