"""The LaTeX tables, compiled as a paper would: two columns, no scaling, nothing wider than its place."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

STANDARD = Path(__file__).parents[2] / "results" / "standard"
PAPER = r"""\documentclass[10pt,twocolumn]{{article}}
\usepackage[T1]{{fontenc}}\usepackage{{booktabs}}
\setlength{{\textwidth}}{{7in}}\setlength{{\oddsidemargin}}{{-0.25in}}\setlength{{\columnsep}}{{0.25in}}
\begin{{document}}Text.\clearpage {inputs}\clearpage\end{{document}}
"""
NEGLIGIBLE = 1.0
"""Points that a box may be too wide without a reader seeing it: a third of a millimetre."""


def overfull(folder, tables):
    inputs = r"\clearpage ".join(rf"\input{{{path.as_posix()}}}" for path in tables)
    (folder / "paper.tex").write_text(PAPER.format(inputs=inputs))
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "-draftmode", "paper.tex"]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, errors="replace", timeout=60, check=False
    )
    assert done.returncode == 0, done.stdout[-2000:]
    widths = re.findall(
        r"Overfull \\hbox \(([\d.]+)pt too wide\)[^\n]*", (folder / "paper.log").read_text(errors="replace")
    )
    return [width for width in widths if float(width) > NEGLIGIBLE]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_every_stored_table_fits(tmp_path):
    """The one of claims, which was 230 pt too wide, too."""
    tables = sorted(STANDARD.glob("*/*.tex"))
    assert len(tables) > 8
    for number, table in enumerate(tables):
        (tmp_path / str(number)).mkdir()
        assert overfull(tmp_path / str(number), [table]) == [], table
