"""The generated parts of the documents, and their comparison with the documents as they are."""

import json

from bench.experiment import config
from bench.gradient import rules
from docs import build


def test_a_stale_document_is_listed_with_its_lines_and_not_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(build, "ROOT", tmp_path)
    monkeypatch.setattr(build, "DOCS", tmp_path)
    page = tmp_path / "columns.md"
    page.write_text(build.columns_page())
    assert build.main(["--check", "columns"]) == 0
    assert not capsys.readouterr().out
    page.write_text(page.read_text().replace("# Columns", "# Rows"))
    assert build.main(["--check", "columns"]) == 1
    assert capsys.readouterr().out.splitlines() == [
        "--- columns.md",
        "+++ written again",
        "@@ -1 +1 @@",
        "-# Rows",
        "+# Columns",
    ]
    assert page.read_text().startswith("# Rows")


def test_answers_stand_under_their_question_and_experiments_without_rows_last(tmp_path, monkeypatch):
    (tmp_path / "quick").mkdir()
    (tmp_path / "quick" / "chart.png").write_bytes(b"")
    record = {"question": "Why?", "answer": "First <b>. Second.", "chart": "chart"}
    (tmp_path / "quick" / "answer.json").write_text(json.dumps(record))
    monkeypatch.setattr(config, "experiments", lambda *_: ["twins", "quick"])
    index = tmp_path / "results.md"
    index.write_text("| question | experiments |\n|---|---|\n| Does it work? | [all](#quick) |\n")
    text = build.results_page(index, tmp_path)
    assert text.endswith(
        "\n## Without stored results\n\n- `twins`: How far are the engines' gradients from the scenes' own?\n<!-- end of answers -->"
    )
    assert (
        "## Does it work?\n\n### quick\n\n![quick](quick/chart.png)\n\nFirst &lt;b&gt;. Second. [Data](quick)\n\n"
        in text
    )


def test_the_table_of_rules_has_the_constants_of_the_code_and_a_status_for_each_kind():
    assert build.rule_page() == (build.DOCS / "gradcheck.md").read_text()
    assert {rule.kind for rule in rules.RULES.values()} == set(rules.STATUS)
