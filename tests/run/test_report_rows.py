"""``report`` shows the rows of the cells that were asked for, or says how its rows differ from them."""

import pandas as pd
import pytest

from bench.cli import main

WORDS = [
    "scenes=[quadratic]",
    "backends=[numpy]",
    "estimators=[fobg]",
    "repeats=4",
    "timing=false",
    "workers=0",
    "formats=[]",
]


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored")
    for samples in (4, 8):
        assert main([*WORDS, f"samples={samples}", f"results_dir={folder}", "--quiet"]) == 0
    return folder


@pytest.mark.parametrize(
    ("words", "samples", "said"),
    [
        (["samples=8"], [8], "bench: 1 stored rows of other settings are not shown"),
        (["sweep.samples=[4,8]"], [4, 8], ""),
        (["samples=5"], [4, 8], "none of the 1 requested cells is stored; the 2 rows shown have other settings"),
        (
            ["sweep.samples=[8,16]"],
            [8],
            "1 of 2 requested cells have no row; 1 stored rows of other settings are not shown",
        ),
    ],
)
def test_a_report_shows_the_requested_rows(stored, capsys, words, samples, said):
    assert main(["report", *WORDS, *words, f"results_dir={stored}"]) == 0
    assert said in capsys.readouterr().err
    table = pd.read_csv(stored / "custom" / "bias_variance.csv")
    assert sorted(table["samples"]) == samples
