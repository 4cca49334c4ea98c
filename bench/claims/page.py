"""Writes the files of all claims: a chart each, the table of figures, a text, and the page."""

from __future__ import annotations

from pathlib import Path

from bench.claims import tables
from bench.claims.tables import Results
from bench.experiment.columns import text
from bench.experiment.views import Views
from bench.report.draw import draw
from bench.report.figures import save, styled
from bench.report.tables import csv_text
from bench.report.web import document
from bench.report.web.data import cells_data
from bench.report.writer import ANSWER, answer_json
from bench.run.files import write_all

QUESTION = "Which published results on gradients through simulators are reproduced?"


def write(directory: Path, results: Results) -> list[Path]:
    """Write charts, tables and the page of all results. Returns the paths of tables and page."""
    drawn = []
    with styled():
        for chart in filter(None, (tables.chart(claim, result) for claim, result in results)):
            drawn.append((chart, [draw(chart)]))
            save(drawn[-1][1][0], directory / chart.name, data=chart.plotted())
    figures, answer = tables.figures_table(results), tables.count_verdicts(results)
    columns = [text("claim"), *tables.FIGURE[:3], tables.FIGURE[4], text("verdict"), text("lesson")]
    cells = cells_data(tables.for_readers(figures), columns)
    views = Views([tables.claims_table(results)], headline=answer)
    content = {
        "claims.md": tables.markdown(results),
        "claims.csv": csv_text(figures),
        "claims.html": document.page(tables.TITLE, QUESTION, views, cells, drawn),
        ANSWER: answer_json("claims", QUESTION, answer, drawn),
    }
    return write_all(directory, content)
