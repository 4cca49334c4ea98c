"""The tables of the stored rows of standard experiments are the stored tables; numbers of CSV files to 1e-9, as machines round."""

import io
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import yaml
from helpers import stored
from numpy.linalg import norm
from trees import ROOT

from bench.experiment.columns import COMMON
from bench.report.draw import BOLD, WIDTH
from bench.report.finish import views_of
from bench.report.style import filled
from bench.report.writer import table_files

EXAMPLE = ROOT / "examples" / "cost_of_error"
FAST = {
    "backward_memory",
    "dose_response/controls",
    "engine_gradients",
    "horizon_growth",
    "identify",
    "optimise/small",
    "quadruped_check",
    "quick",
    "solver_iterations",
    "stability_map",
    "three_errors",
    "train/half_cheetah",
    "twins",
}
"""An experiment of each study."""
FOLDERS = {ROOT / "conf/experiment": [], EXAMPLE / "experiment": [f"plugins={EXAMPLE}"]}
FILES = {path: folder for folder in FOLDERS for path in sorted(folder.rglob("*.yaml"))}
NAMES = {path.relative_to(folder).with_suffix("").as_posix(): FOLDERS[folder] for path, folder in FILES.items()}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in FAST)) for n in NAMES])
def test_tables_of_stored_rows_are_the_stored_tables(name):
    """Where they differ on purpose, write them again: ``python -m bench report +experiment=NAME results_dir=results/standard``."""
    given, rows = stored(name, *NAMES[name])
    given = replace(given, plugins=given.plugins if NAMES[name] else ())  # of another test in this process
    if rows.empty:
        pytest.skip("no rows are stored")
    tables = views_of(given, rows).tables
    for table in (one for one in tables if one.name in (given.study.name, "along_descent")):
        places = [
            one.name
            for one in table.columns
            if one.kind == "text" or one.format in ("setting", "percent") or one.name in COMMON
        ]
        assert not table.frame[[*places, *filter(None, [table.split])]].astype(str).duplicated().any(), (
            "lines of equal name"
        )
    for table in dict.fromkeys(table.name for table in tables):
        for file, content in table_files([one for one in tables if one.name == table], given.name).items():
            path = given.directory / file
            if path.exists() and path.suffix == ".csv":
                tables_read = (pd.read_csv(one, low_memory=False) for one in (io.StringIO(content), path))
                pd.testing.assert_frame_equal(*tables_read, rtol=1e-9, atol=1e-300, obj=file)
            else:
                assert not path.exists() or content == path.read_text(), file


def test_the_title_of_an_experiment_is_one_question_in_one_line():
    """A title of two lines asked two questions, and no row of its chart answered the second."""
    titles = [title for path in FILES if (title := yaml.safe_load(path.read_text()).get("question"))]
    assert len(titles) > 30
    for title in titles:
        assert title.count("?") == title.endswith("?") == 1, title
        assert "\n" not in filled(title, 0.97 * WIDTH / BOLD), title


def test_the_chart_of_a_solver_shows_the_errors_of_stored_gradients_that_have_not_converged():
    given, rows = stored("solver_iterations")
    (chart,) = views_of(given, rows).charts
    drawn = chart.frame
    errors = [norm(np.subtract(a, b)) / norm(b) for a, b in zip(drawn.gradient, drawn.converged_gradient, strict=True)]
    assert drawn[chart.y[0].name].to_numpy() == pytest.approx(errors, rel=1e-6, abs=1e-12)
    assert len(drawn) == (rows["iterations"] < given.study.converged).sum() > 0
