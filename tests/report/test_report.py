"""Tables and charts from rows, held to what they promise and to what goes wrong in them."""

import csv
import json
import math
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from bench.plugins.studies.bias_variance import views as tables
from bench.plugins.studies.bias_variance.charts import FLOOR, RMSE
from bench.plugins.studies.bias_variance.columns import TABLE
from bench.plugins.studies.bias_variance.comparisons import at_equal_rollouts, lowest, method_table, problems_by_axis
from bench.plugins.studies.bias_variance.time_to_accuracy import with_gradient_cost
from helpers import (
    BACKENDS,
    NAMES,
    STIFFNESS,
    charts_of,
    experiment,
    failed,
    loaded,
    row,
    rows_of,
    small_rows,
    stiffness_rows,
    table,
)
from matplotlib.text import Text
from PIL import Image

from bench.experiment.axes import axes
from bench.experiment.columns import Column, text
from bench.experiment.views import Chart, Mark, Views
from bench.report import latex, views, writer
from bench.report.draw import BESIDE, NARROW, WIDTH, draw
from bench.report.figures import DPI, save, styled
from bench.report.problems import split_by_problem


@pytest.fixture
def made(tmp_path):
    """An experiment whose files can be written."""
    found = experiment(tmp_path)
    found.directory.mkdir()
    return found


def written(made, rows):
    """The paths of all files of rows, tables and charts."""
    shown = made.study.views(made, rows)
    return writer.write(made, shown, writer.drawings(made, shown))


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """An experiment, its rows, and the names of its written files: for tests that only read them."""
    found, rows = experiment(tmp_path_factory.mktemp("full")), small_rows(stiffness=(1e2, 1e4, 1e6))
    found.directory.mkdir()
    return found, rows, {path.name for path in written(found, rows)}


# ---------------------------------------------------------------------------------------------------------- tables


def test_every_promised_file_is_written_and_the_csv_has_the_promised_columns_and_every_digit(full):
    made, rows, names = full
    assert {"bias_variance.csv", "bias_variance.md", "bias_variance.tex", "answer.json", "verdicts.csv"} <= names
    assert {path.name for path in made.directory.iterdir()} == names
    with open(made.directory / "bias_variance.csv", newline="") as file:
        assert next(csv.reader(file)) == [*TABLE, "study", "parameters"]
    back = pd.read_csv(made.directory / "bias_variance.csv")
    assert len(back) == len(rows)
    for name in ("bias", "variance", "time_s"):
        np.testing.assert_array_equal(back[name], rows[name])
    assert set(back["samples"].astype(str)) == {"100"}


def test_pareto_is_what_brute_force_finds():
    time, error = (pd.Series(np.random.default_rng(seed).integers(1, 6, 60) / 10) for seed in (0, 1))
    error.iloc[::7] = 1.3  # worse than the zero estimate, which takes no time
    beaten = [((time < t) & (error < e)).any() or e > 1 for t, e in zip(time, error, strict=True)]
    assert list(views.pareto(time, error)) == [not one for one in beaten]
    assert not views.pareto(pd.Series([0.1, 0.2]), pd.Series([1.2, 1.1])).any()


def test_failed_cells_are_rows_with_their_reason(full):
    made, rows, _ = full
    stored = pd.read_csv(made.directory / "bias_variance.csv")
    lost = stored[stored["status"] == "nonfinite"]
    assert len(stored) == len(rows)
    assert len(lost) == (rows["status"] == "nonfinite").sum() > 0
    assert lost["reason"].str.contains("3 of 32 estimates are not finite, first repeat 4 of seed 0").any()
    text = (made.directory / "bias_variance.md").read_text()
    signs = [table.frame.filter(like="_note").map(lambda note: "∞" in note).to_numpy().sum() for table in paper(rows)]
    assert sum(signs) > 0
    assert text.count("∞") == sum(signs) + 1, "a sign in each cell of the pivot, and what it means"
    text = (made.directory / "bias_variance.tex").read_text()
    assert text.count(r"$\infty$") == sum(signs) + text.count(r"\begin{table*}")


EVIL = "<script>alert(1)</script>|[x](http://y)*a*_b_`c`$d$\\input{e}%f&g#h~i^j\nnext \x1b[31mline"


def test_text_is_escaped_in_every_format(made):
    rows = table([row(scene=EVIL), row(scene="tame"), failed("error", EVIL, scene="other")])
    written(made, rows)
    markdown = (made.directory / "bias_variance.md").read_text()
    assert "<script>" not in markdown
    assert "](http" not in markdown
    body = [line for line in markdown.splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in body} == {5}
    text = (made.directory / "bias_variance.tex").read_text()
    plain = re.sub(
        r"\\[a-zA-Z]+(\{\})?|\\[&%$#_{}]|\$[<>|]\$", "", "\n".join(text.replace(latex.FIT, "").splitlines()[4:])
    )
    plain = plain.replace("$$", "")  # what is left of a sign such as $\infty$
    plain = plain.replace(r"\\", "")
    assert not set(plain) & set("$#_%~^<>|")
    assert r"\input" not in text
    assert pd.read_csv(made.directory / "bias_variance.csv")["scene"][0] == EVIL


# -------------------------------------------------------------------------------------------------------- terminal


def show(made, rows):
    writer.show(made, rows, made.study.views(made, rows))


def families(rows, column, **given):
    """The problems of rows along the axis of that column."""
    shown = views.arrange(experiment(**given), rows)
    return split_by_problem(shown, named(shown, column))


def named(shown, column):
    return next(axis for axis in shown.axes if axis.column == column)


def test_backends_that_agree_are_one_line():
    rows = stiffness_rows(sigmas=(0.1,), estimators=("fobg",), backends=("jax", "torch", "numpy"))

    def merged():
        family = families(rows, "stiffness")[0]
        return list(views.estimator_curves(family.rows)["backends"].unique())

    assert merged() == ["jax, torch, numpy"]
    rows.loc[rows["backend"] == "torch", "rmse"] *= 1.5
    assert merged() == ["jax, numpy", "torch"]


# ---------------------------------------------------------------------------------------------------------- charts


def figure_of(chart):
    with styled():
        return draw(chart)


def test_a_value_of_0_is_hollow_and_a_useless_one_a_number_that_stands_outside_its_panel_and_crosses_no_other():
    """A log axis dropped what is 0, one value of 1e24 squeezed all others, and numbers stood on lines."""
    frame = pd.DataFrame({"x": [1.0, 2.0, 3.0] * 2, "rmse_rel": [0.0, 1e3, 1e4, 0.2, 0.3, 1e24], "name": [*"aaabbb"]})
    chart = Chart("one", frame, [Column("x", log=False)], [replace(RMSE, low="", high="", limit="")], series="name")
    (panel,) = figure_of(chart).axes
    hollow = [line for line in panel.lines if line.get_markerfacecolor() == "none" and len(line.get_ydata())]
    assert [list(line.get_ydata()[line.get_markevery()]) for line in hollow] == [[FLOOR]]
    assert np.isnan(panel.lines[0].get_ydata()[0])
    assert [text.get_text() for text in panel.texts] == ["● 1.0e4", "■ 1.0e24"], "each with its marker"
    arrows = [line.get_xdata().tolist() for line in panel.lines if line.get_marker() == "$↑$" and len(line.get_xdata())]
    assert arrows == [[2.0, 3.0], [3.0]]
    assert panel.lines[0].get_ydata()[-1] == 1e4, "a line leads to a value beyond the axis, and shows no plateau"
    boxes = [text.get_window_extent() for text in panel.texts]
    assert all(box.y0 >= panel.bbox.y1 for box in boxes)
    assert not boxes[0].overlaps(boxes[1])


def test_marks_at_the_same_place_are_beside_each_other():
    """Of lines on top of each other only the last was seen."""
    frame = pd.DataFrame({"x": [1.0, 2.0, 3.0] * 2, "y": [1.0, 2.0, 3.0] * 2, "name": [*"aaabbb"]})
    (panel,) = figure_of(Chart("one", frame, [Column("x")], [Column("y")], series="name")).axes
    first, second = (line.get_transform().transform(line.get_xydata()) for line in panel.lines[:2])
    assert np.ptp([first[:, 0], second[:, 0]], axis=0) == pytest.approx(BESIDE / 72 * panel.figure.dpi)
    assert first[:, 1] == pytest.approx(second[:, 1])


def test_an_interval_without_an_end_reaches_the_edge():
    """A ratio without an upper end vanished with its row."""
    frame = pd.DataFrame({"x": [2.0, 3.0, math.inf], "low": [0.0, 1.0, 2.0], "high": math.inf, "name": [*"abc"]})
    column = Column("x", low="low", high="high", log=True)
    (panel,) = figure_of(Chart("one", frame, [column], [text("name")], "dots")).axes
    low, high = panel.get_xlim()
    bars = panel.collections[0].get_segments()
    assert [(start < low, end > high) for (start, _), (end, _) in bars] == [(True, True), (False, True), (False, True)]


@pytest.mark.parametrize("at", [0.0, -1.0, 1e9])
def test_a_named_value_of_x_does_not_decide_its_range(at):
    frame = pd.DataFrame({"x": [1.0, 10.0, 100.0], "y": [1.0, 2.0, 3.0]})
    columns = [Column("x", log=True)], [Column("y", log=True)]
    plain, marked = (figure_of(Chart("one", frame, *columns, marks=marks)) for marks in ([], [Mark("limit", at)]))
    assert marked.axes[0].get_xlim() == plain.axes[0].get_xlim()


LIMITED = {"kind": "grid", "level": "level", "limit": "limit", "limit_name": "edge", "failed_name": "not run"}


@pytest.mark.parametrize(
    ("values", "column", "more", "legend"),
    [
        ({}, {"least": 1.5}, {}, ["upper limit"]),
        ({}, {"low": "x", "high": "high", "ends": "range of calls"}, {}, ["range of calls"]),
        ({}, {}, {"failed": "lost", "failed_name": "not reached"}, ["not reached"]),
        ({"limit": math.inf}, {}, LIMITED, ["good", "blank: not run"]),
        ({"limit": 1.5}, {}, LIMITED, ["good", "blank: not run", "edge"]),
    ],
)
def test_each_kind_of_mark_that_is_drawn_is_in_the_legend_and_no_other(values, column, more, legend):
    """Bars, crosses, hollow markers and blank cells were explained by hand, or not; a line that no map had was listed."""
    frame = pd.DataFrame(
        {"x": [1.0, 2.0, 3.0], "y": [1.0, 2.0, 3.0], "high": 4.0, "lost": [False, False, True], "level": "good"}
    )
    figure = figure_of(
        Chart(
            "one",
            frame.assign(**values),
            [Column("x")],
            [Column("y", log=True, **column)],
            **more,
        )
    )
    assert [text.get_text() for shown in figure.legends for text in shown.get_texts()] == legend


def test_beyond_a_named_value_the_chart_is_shaded():
    plain = charts_of(small_rows())["bias_variance_stiffness"]
    assert [(mark.name, mark.at, mark.to) for mark in plain.marks] == [("beyond the step size limit", 6400.0, math.inf)]


def test_where_no_method_reaches_an_error_no_table_of_times_is_drawn():
    """It was an internal error after the run."""
    rows = table([row(samples=n, bias=1.0, bias_low=0.9, variance=4.0, time_s=1e-3) for n in (4, 16, 64)])
    assert "speed_accuracy" not in charts_of(rows, sweep={"samples": [4, 16, 64]})


def test_nothing_swept_gives_a_table_of_estimators_and_problems():
    rows = table(
        [row(estimator=e, backend=b, scene=s) for e in NAMES for b in BACKENDS for s in ("pushing", "heaviside")]
    )
    found = charts_of(rows, sweep={"sigma": [0.1]})
    assert set(found) == {"estimators", "speed_accuracy"}
    assert set(found["estimators"].frame["series"]) == set(NAMES)
    assert found["estimators"].kind == "grid"
    assert found["estimators"].subtitle.startswith("relative RMSE at equal rollouts (")


def test_a_parameter_in_an_identity_string_is_an_axis():
    """The default value is left out of identity strings, and so is the one value that no string has."""
    sweep = {"ratio": [3.0, 1.5, 10.0]}
    rows = table([row(estimator="alpha_order", estimator_params=p) for p in ("", "ratio=3", "delta=0.3,ratio=10")])
    rows = pd.concat([rows, table([row()])], ignore_index=True)
    shown = views.arrange(experiment(sweep=sweep), rows)
    found = views.rows_along(shown, named(shown, "ratio"))
    assert list(found["x"]) == [1.5, 3.0, 10.0]
    assert list(found["estimator_params"]) == ["", "", "delta=0.3"]
    assert "bias_variance_ratio" in charts_of(rows, sweep=sweep)


def test_a_problem_is_named_by_every_parameter_that_differs_from_its_scenes_defaults():
    words = ["contacts=['penalty[stiffness=1e5]']", "sweep.samples=[16,64]", "estimators=[fobg]"]
    for more, name in (
        (["scenes=['pushing[sigma=0.2]',bouncing_ball]"], "pushing[sigma=0.2], penalty[stiffness=100000]"),
        (
            ["scenes=['pushing[horizon=8]']", "sweep.sigma=[0.1,0.3]"],
            "pushing[horizon=8], penalty[stiffness=100000], sigma=0.1",
        ),
        (["contacts=[penalty]", "scenes=[pushing]", "sweep.stiffness=[10,1e5]"], "pushing, penalty, stiffness=10"),
        (["scenes=[pushing]", "sweep.mass=[0.1,0.2]"], "pushing, penalty[stiffness=100000], mass=0.1"),
    ):
        given, cells = loaded(*words, *more)
        shown = views.arrange(given, rows_of(given, cells))
        assert split_by_problem(shown, axes(given.sweep, shown.rows)[0], ("scene", "contact"))[0].title() == name


def test_the_parameter_behind_smoothing_is_an_axis():
    sweep = {"union": [{"beta": [1.0, 10.0]}, {"kappa": [1e-6, 1e-4]}]}
    rows = [row(contact="softplus", smoothing=b) for b in (1.0, 10.0)]
    rows += [row(contact="complementarity", smoothing=k) for k in (1e-6, 1e-4)] + [row()]
    figures = charts_of(table(rows), sweep=sweep)
    assert set(figures) == {"bias_variance_beta", "bias_variance_kappa"}
    assert set(figures["bias_variance_beta"].frame["contact"]) == {"softplus"}


def test_zipped_axes_do_not_split_problems_and_are_named_together():
    sweep = {"zip": {"stiffness": [1e2, 1e4], "dt": [0.01, 0.001]}}
    rows = table([row(stiffness=k, dt=h) for k, h in ((1e2, 0.01), (1e4, 0.001))])
    assert len(families(rows, "stiffness", sweep=sweep)) == 1
    charts = charts_of(rows, sweep=sweep)
    assert set(charts) == {"bias_variance_stiffness"}
    assert "dt" in charts["bias_variance_stiffness"].x[0].heading
    titles = [axis.title for axis in views.arrange(experiment(sweep=sweep), rows).axes]
    assert titles == ["stiffness [N/m], and with it dt", "dt [s], and with it stiffness"]


def test_seeds_become_medians_of_those_that_are_ok():
    rows = [row(stiffness=k, seed=s, bias_rel=0.1 * s) for k in (1e2, 1e4) for s in range(5)]
    rows[-1] = failed("nonfinite", "1 of 32 estimates are not finite", stiffness=1e4, seed=4)
    merged = views.merge_seeds(table(rows))
    assert list(merged["bias_rel"]) == pytest.approx([0.2, 0.15])


ODD = {
    "no_gradient": {"reference_norm": 0.0, "bias_rel": math.nan, "rmse_rel": math.nan},
    "exact": {"bias": 0.0, "bias_low": 0.0, "bias_high": 0.0, "variance": 0.0, "variance_low": 0.0},
    "infinite": {"bias": math.inf, "bias_high": math.inf, "variance": math.inf, "rmse": math.inf},
    "no_interval": {"bias_low": math.nan, "bias_high": math.nan, "variance_high": math.inf},
    "no_time": {"time_s": 0.0, "rmse_rel": 0.0},
    "$s_1": {"estimator": "_x$", "dt": 0.0},
}
"""Scenes with odd columns."""


@pytest.mark.parametrize(
    "rows",
    [
        [failed(status, "it broke", stiffness=k) for status in ("error", "unsupported") for k in (1e2, 1e4)],
        [row(scene=name, stiffness=k, **odd) for name, odd in ODD.items() for k in (1e2, 1e4)],
        [row()],
    ],
    ids=["error", "odd", "single"],
)
def test_odd_rows_break_nothing(rows, made, capsys):
    written(made, table(rows))
    show(made, table(rows))
    assert capsys.readouterr().out


# ----------------------------------------------------------------------------------------------------------- paper


def test_every_bias_and_interval_of_the_rows_is_in_the_data_of_the_chart(tmp_path):
    rows = small_rows(stiffness=STIFFNESS[:4], backends=("jax",))
    made = experiment(tmp_path, sweep={"stiffness": list(STIFFNESS[:4])})
    made.directory.mkdir()
    written(made, rows)
    found = pd.read_csv(tmp_path / "made_up" / "bias_variance_stiffness.plotted.csv")
    for _, cell in rows[rows["bias_low"] > 0].iterrows():
        ends = cell[["bias", "bias_low", "bias_high"]] / cell["reference_norm"]
        names = ["bias_shown", "bias_from", "bias_to"]
        near = np.isclose(found[names], ends.to_numpy(dtype=float), rtol=1e-6).all(axis=1)
        assert (found["series"][near] == cell["estimator"]).any()


def test_charts_in_files_are_one_column_wide_on_request_with_texts_of_7_points(made):
    """At 3.5 inches, panels beside each other and numbers in narrow cells were unreadable."""
    frame = pd.DataFrame(
        [
            {"x": f"a long name {i}", "y": f"row {j}", "panel": p, "level": "good", "cell": "1234.5"}
            for p in "ab"
            for i in range(9)
            for j in range(2)
        ]
    )
    grid = Chart(
        "grid", frame, [text("x", label="")], [text("y", label="")], "grid", panel="panel", level="level", cell="cell"
    )
    for columns, inches in ((2, WIDTH), (1, NARROW)):
        given = replace(made, chart_columns=columns)
        drawn = writer.drawings(given, Views(charts=[grid]))
        *_, path = writer.write(given, Views(charts=[grid]), drawn)
        with Image.open(path.with_suffix("").with_suffix(".png")) as image:
            assert image.width == pytest.approx(inches * DPI, abs=1)
    texts = [one for figure in drawn[0][1] for one in figure.findobj(Text) if one.get_text()]
    assert min(one.get_fontsize() for one in texts) >= 7
    assert len({round(panel.get_position().x0, 3) for panel in drawn[0][1][-1].axes}) == 1


def test_fonts_are_inside_the_files_and_dates_are_not(tmp_path):
    with styled():
        svg, pdf = (
            path.read_bytes()
            for path in save(
                figure_of(Chart("one", pd.DataFrame({"x": [1.0]}), [Column("x")], [Column("x")])),
                tmp_path / "one",
                ("svg", "pdf"),
            )
        )
    assert (b"<text" in svg, b"/FontFile2" in pdf, b"CreationDate" in pdf) == (False, True, False)


def test_best_is_told_only_where_its_interval_is_apart_from_every_other_estimator():
    def rows(other):
        known = (("fobg", (1.0, 2.0), 1.2), ("reinforce", other, 2.0))
        ends = {"gradients": 0, "bias_low": 0.0, "bias_high": 0.0}
        return table(
            [
                row(estimator=name, backend=backend, rmse=rmse, variance_low=low, variance_high=high, **ends)
                for name, (low, high), rmse in known
                for backend in ("jax", "torch")
            ]
        )

    def bold(made):
        return [cell for part in paper(made) for cell in part.frame["x0_best"]]

    assert bold(rows((2.5, 4.0))) == [True, False], "backends that agree share a row"
    assert not any(bold(rows((1.9, 4.0))))
    assert not any(bold(rows((2.5, 4.0)).assign(variance_low=math.nan)))
    assert not any(bold(rows((2.5, 4.0)).assign(rmse_rel=1.5))), "nothing that is no better than zero"
    made = paper(rows((2.5, 4.0)))
    assert (latex.latex(made, "made").count(r"\textbf"), writer.markdown(made, "made").count("**0.")) == (1, 1)


def paper(rows, **settings):
    """The tables of a paper from rows, one per problem."""
    problems = problems_by_axis(views.arrange(experiment(**settings), with_gradient_cost(rows)))
    return tables.pivots(problems, lowest(at_equal_rollouts(method_table(problems))))


def test_the_papers_table_continues_below_and_loses_no_column():
    rows = table([row(estimator=name, stiffness=float(k + 1)) for name in ("fobg", "x" * 80) for k in range(9)])
    made = paper(rows, sweep={"stiffness": [float(k + 1) for k in range(9)]})
    text = latex.latex(made, "made")
    heads = re.findall(r"toprule\n & (.*) \\\\", text)
    assert [head for line in heads for head in line.split(" & ")] == [column.heading for column in made[0].columns[1:]]
    assert len(heads) == text.count(r"\resizebox") == math.ceil(11 / latex.COLUMNS)


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex: apt-get install texlive-science")
def test_table_compiles_in_latex(made):
    rows = table(
        [row(scene=EVIL), failed("error", EVIL, scene="other"), *(row(stiffness=float(k + 1)) for k in range(30))]
    )
    rows.loc[2, ["bias", "bias_low"]] = 0.0
    written(made, rows)
    packages = re.search(r"usepackage\{(.*)\}", (made.directory / "bias_variance.tex").read_text())[1]
    page = r"\documentclass[twocolumn]{article}\setlength{\textwidth}{504pt}"
    text = rf"{page}\usepackage{{{packages}}}\begin{{document}}\input{{bias_variance.tex}}\end{{document}}"
    (made.directory / "paper.tex").write_text(text)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(command, cwd=made.directory, capture_output=True, text=True, errors="replace", timeout=120)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "Overfull" not in done.stdout


# ------------------------------------------------------------------------------------------------------ swept axes

FEW = ("estimators=[fobg]", "backends=[numpy]")


@pytest.mark.slow
def test_no_cell_is_lost_where_a_swept_value_is_the_default_of_one_scene():
    """Damping 1 is what wall_penalty_1d asks of its law, and 0 what bouncing_ball leaves it: no identity string shows either."""
    swept, cells = loaded(*FEW, "scenes=[wall_penalty_1d,bouncing_ball]", "sweep.damping=[0,1,10]")
    rows = rows_of(swept, cells)
    shown = views.arrange(swept, rows)
    assert sorted(views.rows_along(shown, named(shown, "damping"))["x"]) == [0.0, 0.0, 1.0, 1.0, 10.0, 10.0]
    assert [sorted(family.rows["x"]) for family in split_by_problem(shown, named(shown, "damping"))] == [
        [0.0, 1.0, 10.0]
    ] * 2
    chart = next(c for c in swept.study.views(swept, rows).charts if c.name == "bias_variance_damping")
    assert set(chart.frame["x"]) == {0.0, 1.0, 10.0}


def test_the_newest_row_of_a_cell_counts():
    new = table([row(stiffness=k) for k in (1.0, 2.0, 3.0)])
    found = views.newest_rows(pd.concat([new.assign(bias=7.0), new[:2]], ignore_index=True))
    assert list(found["stiffness"]) == [3.0, 1.0, 2.0]
    assert list(found["bias"] == 7.0) == [True, False, False]


def test_a_swept_parameter_named_like_a_column_of_lists_is_an_axis_of_its_own():
    parameters = [json.dumps({"scene": {"name": "quadruped", "gain": value}}) for value in (1.0, 2.0)]
    rows = pd.DataFrame({"parameters": parameters, "gain": [[1.0], [2.0, 3.0]]})
    assert [axis.column for axis in axes({"gain": [1.0, 2.0]}, rows)] == ["swept.gain"]
