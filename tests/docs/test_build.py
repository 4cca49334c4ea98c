"""The generated parts of the documents are up to date."""

import json
from pathlib import Path

import pytest

from bench.errors import UserError
from bench.experiment import config
from docs import build

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_columns_are_up_to_date():
    assert (DOCS / "columns.md").read_text() == build.columns_page(), "run: python -m docs.build columns"


@pytest.mark.skipif(
    not any(build.STANDARD.glob("*/findings.json")), reason="needs the findings that a run writes beside its rows"
)
def test_results_are_up_to_date():
    assert (DOCS / "results.md").read_text() == build.results_page(DOCS / "results.md"), "run: make docs"


def test_results_have_findings_and_name_experiments_without_rows(tmp_path, monkeypatch):
    (tmp_path / "quick").mkdir()
    (tmp_path / "quick" / "chart.png").write_bytes(b"")
    record = {"question": "Why?", "findings": ["First <b>.", "Second."], "chart": "chart"}
    (tmp_path / "quick" / "findings.json").write_text(json.dumps(record))
    monkeypatch.setattr(config, "experiments", lambda *_: ["twins", "quick"])
    page = tmp_path / "page.md"
    page.write_text(f"before {build.MARKS[0]}old{build.MARKS[1]} after")
    text = build.results_page(page, tmp_path)
    assert text.startswith("before ")
    assert text.endswith(" after")
    assert "old" not in text
    assert "`python -m bench +experiment=twins` (no stored results)" in text
    assert (
        "## quick\n\n*Does the whole path work on this machine?*\n\n![quick](quick/chart.png)\n\n- First &lt;b&gt;.\n- Second.\n\n"
        in text
    )
    page.write_text(text)
    assert build.results_page(page, tmp_path) == text


def test_results_need_their_marks(tmp_path):
    page = tmp_path / "results.md"
    page.write_text("no marks")
    with pytest.raises(UserError, match="has no place for the findings"):
        build.results_page(page, tmp_path)


def test_unknown_part_is_refused():
    with pytest.raises(UserError, match="unknown part 'pages' \\(allowed: results, columns, figures, site, all\\)"):
        build.main(["pages"])
