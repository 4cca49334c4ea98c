"""Tables and charts from rows, held to what they promise and to what goes wrong in them."""

from __future__ import annotations

import csv
import itertools
import math
import re
import shutil
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from bench.grid import Experiment
from bench.report import charts, tables, terminal, views
from bench.report.figures import save, styled
from bench.report.plotted import plotted
from bench.store import BIAS_VARIANCE

NAMES = ("alpha_order", "finite_difference", "fobg", "inverse_variance", "randomized_smoothing", "reinforce")
STIFFNESS = (1e1, 1e2, 1e3, 3e3, 1e4, 1e5, 1e6)
IDENTITY = [
    "experiment",
    "scene",
    "contact",
    "integrator",
    "backend",
    "estimator",
    "estimator_params",
    "noise",
    "horizon",
    "dt",
    "stiffness",
    "sigma",
    "smoothing",
    "samples",
    "repeats",
    "dim",
    "seed",
    "dtype",
    "key",
]
BACKENDS = ("jax", "torch", "numpy", "implicit")
SPEED = {"jax": 2e-4, "torch": 8e-3, "numpy": 3e-3, "implicit": 6e-4}


def row(**values):
    """A row like those of a run: first-order estimates turn biased and wild where contact is stiff, others do not."""
    given = {
        "scene": "pushing", "contact": "penalty", "integrator": "semi_implicit_euler", "backend": "jax",
        "estimator": "fobg", "noise": "action", "horizon": 20, "dt": 0.01, "stiffness": 1e3, "sigma": 0.1,
        "samples": 100, "repeats": 32, "dim": 20, "seed": 0, "status": "ok", "dtype": "float64", "device": "cpu",
    } | values  # fmt: skip
    k, sigma, n = given["stiffness"], given["sigma"], given["samples"]
    stiff = max(k, 1.0) / 3e3 if math.isfinite(k) else 0.1
    first = given["estimator"] in ("fobg", "alpha_order", "inverse_variance")
    share = {"alpha_order": 0.3, "inverse_variance": 0.1}.get(given["estimator"], 1.0)
    bias = share * stiff / (1 + stiff) if first and given["contact"] == "penalty" else 0.0
    variance = (0.05 + share * stiff**2 * sigma if first else 6.0 / (1 + 10 * sigma)) * 10 / n
    generator = np.random.default_rng(zlib.crc32(repr((k, sigma, given["estimator"], n, given["seed"])).encode()))
    se = math.sqrt(variance / given["repeats"])
    bias = max(0.0, bias + 0.3 * se * generator.standard_normal())
    low, high = max(0.0, bias - 2 * se), bias + 2 * se
    if low == 0:
        bias = 0.0
    norm = 4.0
    time = SPEED.get(given["backend"], 1e-3) * (n / 100) ** 0.9 * (1.0 if first else 0.4)
    result = BIAS_VARIANCE.blank()
    result |= {
        "experiment": "made_up", "reference_norm": norm, "grad_norm": norm * (1 + bias), "reference_method": "quadrature",
        "reference_se": 0.0, "bias": norm * bias, "bias_low": norm * low, "bias_high": norm * high, "bias_rel": bias,
        "variance": norm**2 * variance, "variance_low": norm**2 * variance * 0.6, "variance_high": norm**2 * variance * 1.8,
        "variance_per_sample": norm**2 * variance * n, "rmse": norm * math.hypot(bias, math.sqrt(variance)),
        "rmse_rel": math.hypot(bias, math.sqrt(variance)), "cosine": 1 / math.sqrt(1 + bias**2 + variance),
        "sign_agreement": 0.9, "finite_fraction": 1.0, "time_s": time, "time_iqr_s": 0.15 * time, "compile_s": 0.3,
        "rollouts": n, "gradients": n if first else 0, "peak_memory_mb": 300.0, "versions": "numpy=2.4",
    }  # fmt: skip
    result |= given
    result["key"] = f"{zlib.crc32(repr(sorted(given.items())).encode()):08x}"
    return result


def failed(status, reason, **values):
    """A row without results."""
    made = row(**values)
    return {name: made[name] if name in IDENTITY else BIAS_VARIANCE.blank()[name] for name in made} | {
        "status": status,
        "reason": reason,
    }


def table(rows):
    return BIAS_VARIANCE.typed(pd.DataFrame(rows))


def stiffness_rows(stiffness=STIFFNESS, sigmas=(0.1, 0.3), estimators=NAMES, backends=BACKENDS):
    """4 backends x 6 estimators x 2 contact laws x 7 stiffnesses x 2 sigmas."""
    rows = []
    for sigma, k, contact, backend, estimator in itertools.product(
        sigmas, stiffness, ("penalty", "complementarity"), backends, estimators
    ):
        cell = {"sigma": sigma, "stiffness": k, "contact": contact, "backend": backend, "estimator": estimator}
        cell["smoothing"] = 1e-6 if contact == "complementarity" else math.nan
        if contact == "complementarity" and backend != "implicit":
            rows.append(
                failed("unsupported", f"{contact} solves an equation each step, backend {backend} has none", **cell)
            )
        elif k == 1e6 and estimator in ("fobg", "inverse_variance") and contact == "penalty":
            rows.append(failed("nonfinite", "3 of 32 estimates are not finite, first repeat 4 of seed 0", **cell))
        else:
            rows.append(row(**cell))
            if backend == "numpy":
                rows[-1]["rmse"] *= 1 + 1e-5
    return table(rows)


def small_rows(**given):
    """Two stiffnesses at one sigma."""
    return stiffness_rows(**{"stiffness": (1e2, 1e4), "sigmas": (0.1,), **given})


def experiment(directory=Path("unused"), sweep=None, marks=None, name="made_up"):
    return Experiment(
        name=name,
        choices={},
        sweep=sweep if sweep is not None else {"sigma": [0.1, 0.3], "stiffness": list(STIFFNESS)},
        results_dir=directory,
        question="As contact stiffens, which gradient stays right?",
        marks=marks if marks is not None else {"stiffness": {"step size limit": 6400}},
    )


# ---------------------------------------------------------------------------------------------------------- tables


def test_csv_has_the_promised_columns_in_order_and_every_digit(tmp_path):
    rows = stiffness_rows()
    tables.write(rows, tmp_path)
    with open(tmp_path / "bias_variance.csv", newline="") as file:
        assert next(csv.reader(file)) == list(BIAS_VARIANCE.names)
    back = pd.read_csv(tmp_path / "bias_variance.csv")
    assert len(back) == len(rows)
    for name in ("bias", "variance", "time_s"):
        np.testing.assert_array_equal(back[name], rows[name])
    assert set(back["samples"].astype(str)) == {"100"}


def test_every_promised_file_is_written(tmp_path):
    names = {path.name for path in tables.write(stiffness_rows(), tmp_path)}
    assert names == {"bias_variance.csv", "bias_variance.md", "bias_variance.tex", "speed_accuracy.csv"}
    assert {path.name for path in tmp_path.iterdir()} == names


def test_pareto_is_what_brute_force_finds(tmp_path):
    generator = np.random.default_rng(0)
    rows = small_rows()
    rows["time_s"] = generator.integers(1, 6, len(rows)) / 1e3
    rows["rmse_rel"] = generator.integers(1, 6, len(rows)) / 10
    tables.write(rows, tmp_path)
    found = pd.read_csv(tmp_path / "speed_accuracy.csv")
    assert found["pareto"].sum() > 4
    same = ["scene", "contact", "integrator", "horizon", "dt", "stiffness", "sigma", "smoothing", "noise"]
    found["smoothing"] = found["smoothing"].fillna(-1.0)
    lines = found.to_dict("records")
    for line in lines:
        rivals = [r for r in lines if r["status"] == "ok" and all(r[c] == line[c] for c in same)]
        beaten = any(r["time_s"] < line["time_s"] and r["rmse_rel"] < line["rmse_rel"] for r in rivals)
        assert line["pareto"] == (line["status"] == "ok" and not beaten)


def test_bias_within_its_noise_is_told_apart(tmp_path):
    rows = table([row(bias_low=0.0, bias_high=0.124, bias=0.05), row(seed=1, bias=0.5, bias_low=0.4, bias_high=0.6)])
    tables.write(rows, tmp_path)
    for name in ("bias_variance.md", "bias_variance.tex"):
        text = (tmp_path / name).read_text().replace("$<$", "<").replace("{[}", "[").replace("{]}", "]")
        assert "0 (< 0.124)" in text
        assert "0.500 [0.400, 0.600]" in text
        assert "not distinguishable from 0" in text


def test_failed_cells_are_rows_with_their_reason(tmp_path):
    rows = stiffness_rows()
    tables.write(rows, tmp_path)
    text = (tmp_path / "bias_variance.md").read_text()
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len(lines) == 2 + len(rows)
    assert sum("| nonfinite (" in line for line in lines) == (rows["status"] == "nonfinite").sum() > 0
    assert "3 of 32 estimates are not finite, first repeat 4 of seed 0" in text
    assert (tmp_path / "bias_variance.tex").read_text().count(r"\\") == 1 + len(rows)


EVIL = "<script>alert(1)</script>|[x](http://y)*a*_b_`c`$d$\\input{e}%f&g#h~i^j\nnext \x1b[31mline"


def test_text_is_escaped_in_every_format(tmp_path):
    rows = table([row(scene=EVIL), row(scene="tame"), failed("error", EVIL, scene="other")])
    tables.write(rows, tmp_path)
    markdown = (tmp_path / "bias_variance.md").read_text()
    assert "<script>" not in markdown
    assert "](http" not in markdown
    body = [line for line in markdown.splitlines() if line.startswith("|")]
    assert len(body) == 5
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in body}) == 1
    latex = (tmp_path / "bias_variance.tex").read_text()
    plain = re.sub(r"\\[a-zA-Z]+(\{\})?|\\[&%$#_{}]|\$[<>|]\$", "", "\n".join(latex.splitlines()[4:]))
    plain = plain.replace(r"\\", "")
    assert not set(plain) & set("$#_%~^<>|")
    assert r"\input" not in latex
    assert pd.read_csv(tmp_path / "bias_variance.csv")["scene"][0] == EVIL


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0213, "0.021"), (0.996, "1.0"), (350.0, "350"), (1234.0, "1200"), (123456.0, "1.2e5"), (2e-7, "2.0e-7"),
     (0.0, "0"), (math.nan, "-"), (math.inf, "inf")],
)  # fmt: skip
def test_numbers_are_short(value, text):
    assert views.number(value) == text


# -------------------------------------------------------------------------------------------------------- terminal


@pytest.mark.parametrize("rows", [stiffness_rows(), small_rows(backends=("jax",))])
def test_terminal_output_fits_and_says_what_matters(rows, capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    terminal.show(experiment(), rows, ["sigma", "stiffness"])
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 100
    assert text.isascii()
    assert "As contact stiffens, which gradient stays right?" in text
    assert f"{len(rows)} cells: " in text
    for status, count in rows["status"].value_counts().items():
        assert f"{count} {status}" in text
    assert "lowest error" in text


def test_backends_that_agree_are_one_line():
    rows = stiffness_rows(sigmas=(0.1,), estimators=("fobg",), backends=("jax", "torch", "numpy"))

    def merged():
        family = views.families(views.along(rows, "stiffness", experiment()))[0]
        return [dict(line.backends) for line in views.lines(family.rows)]

    assert merged() == [{"jax": True, "torch": True, "numpy": False}]
    rows.loc[rows["backend"] == "torch", "rmse"] *= 1.5
    assert merged() == [{"jax": True, "numpy": False}, {"torch": True}]


def test_terminal_takes_names_literally(capsys):
    rows = table([row(estimator_params="baseline=[bold]x", scene="[red]s[/red]", samples=n) for n in (16, 64)])
    terminal.show(experiment(sweep={"samples": [16, 64]}), rows, ["samples"])
    text = capsys.readouterr().out
    assert "fobg[baseline=[bold]x]" in text
    assert "[red]s[/red]" in text


# ---------------------------------------------------------------------------------------------------------- charts


def drawn(rows, axes, sweep=None, names=NAMES):
    with styled():
        return charts.figures(experiment(sweep=sweep), rows, axes, names)


def curves(panel):
    """Colour of each labelled line of a panel."""
    found = {}
    for line in panel.lines:
        if not line.get_label().startswith("_"):
            found.setdefault(line.get_label(), set()).add(line.get_color())
    for container in panel.containers:
        if not container.get_label().startswith("_"):
            found.setdefault(container.get_label(), set()).add(container.lines[0].get_color())
    found.pop("Pareto front", None)
    return found


def test_charts_are_written_as_pictures_and_data(tmp_path):
    made = experiment(tmp_path)
    made.directory.mkdir()
    paths = charts.write(made, small_rows(sigmas=(0.1, 0.3)), ["sigma", "stiffness"], NAMES)
    stems = {"bias_variance_sigma", "bias_variance_stiffness", "speed_accuracy"}
    assert {path.name for path in paths} == {
        f"{stem}.{suffix}" for stem in stems for suffix in ("png", "svg", "pdf", "plotted.csv")
    }
    for path in paths:
        content = path.read_bytes()
        starts = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF", ".csv": b"panel,"}
        assert content.startswith(starts[path.suffix])
        assert len(content) > 10_000


def test_one_line_per_estimator_and_one_colour_everywhere():
    figures = drawn(stiffness_rows(), ["sigma", "stiffness"])
    panels = figures["bias_variance_stiffness"].axes
    assert len(panels) == 2 * 4
    colours = {}
    for figure in figures.values():
        for panel in figure.axes:
            assert set(curves(panel)) == set(NAMES)
            for name, found in curves(panel).items():
                colours.setdefault(name, set()).update(found)
    assert all(len(found) == 1 for found in colours.values())
    assert len(set.union(*colours.values())) == len(NAMES)


def test_colours_do_not_depend_on_which_estimators_ran():
    few, all_of_them = (
        drawn(small_rows(estimators=names), ["stiffness"])["bias_variance_stiffness"]
        for names in (("reinforce", "fobg"), NAMES)
    )
    assert curves(few.axes[0]) == {name: curves(all_of_them.axes[0])[name] for name in ("reinforce", "fobg")}


def test_backends_that_differ_get_a_line_of_their_own():
    rows = small_rows()
    rows.loc[(rows["backend"] == "torch") & (rows["estimator"] == "fobg"), ["rmse", "variance"]] *= 2
    panel = drawn(rows, ["stiffness"])["bias_variance_stiffness"].axes[0]
    lines = [line for line in panel.lines if line.get_label() == "fobg"]
    assert len(lines) == 2
    assert lines[0].get_linestyle() != lines[1].get_linestyle()


def test_failed_cells_are_crosses():
    rows = stiffness_rows(sigmas=(0.1,))
    panels = drawn(rows, ["stiffness"])["bias_variance_stiffness"].axes
    crosses = [[line for line in panel.lines if line.get_marker() == "x"] for panel in panels]
    assert [len(found) for found in crosses] == [2, 0, 2, 0]  # fobg and inverse_variance, bias and variance


def test_marks_are_drawn():
    panels = drawn(small_rows(), ["stiffness"])["bias_variance_stiffness"].axes
    assert all(any(list(line.get_xdata()) == [6400, 6400] for line in panel.lines) for panel in panels)


def test_nothing_swept_gives_an_overview():
    rows = table([row(estimator=e, backend=b) for e in NAMES for b in BACKENDS])
    figures = drawn(rows, ["sigma"], sweep={"sigma": [0.1]})
    assert set(figures) == {"overview", "speed_accuracy"}
    assert set(curves(figures["overview"].axes[0])) == set(NAMES)


def test_a_parameter_in_an_identity_string_is_an_axis():
    """The default value is left out of identity strings, and so is the one value that no string has."""
    sweep = {"gamma": [0.1, 1.0, 10.0]}
    rows = table([row(estimator="alpha_order", estimator_params=p) for p in ("", "gamma=0.1", "delta=0.3,gamma=10")])
    rows = pd.concat([rows, table([row()])], ignore_index=True)
    found = views.along(rows, "gamma", experiment(sweep=sweep))
    assert list(found["x"]) == [1.0, 0.1, 10.0]
    assert list(found["estimator_params"]) == ["", "", "delta=0.3"]
    assert "bias_variance_gamma" in drawn(rows, ["gamma"], sweep=sweep)


def test_the_parameter_behind_smoothing_is_an_axis():
    sweep = {"union": [{"beta": [1.0, 10.0]}, {"kappa": [1e-6, 1e-4]}]}
    rows = [row(contact="softplus", smoothing=b) for b in (1.0, 10.0)]
    rows += [row(contact="complementarity", smoothing=k) for k in (1e-6, 1e-4)] + [row()]
    figures = drawn(table(rows), ["beta", "kappa"], sweep=sweep)
    assert set(figures) == {"bias_variance_beta", "bias_variance_kappa"}
    assert len(figures["bias_variance_beta"].axes) == 2


def test_zipped_axes_do_not_split_problems():
    sweep = {"zip": {"stiffness": [1e2, 1e4], "dt": [0.01, 0.001]}}
    rows = table([row(stiffness=k, dt=h) for k, h in ((1e2, 0.01), (1e4, 0.001))])
    assert len(views.families(views.along(rows, "stiffness", experiment(sweep=sweep)))) == 1
    assert set(drawn(rows, ["stiffness", "dt"], sweep=sweep)) == {"bias_variance_stiffness", "bias_variance_dt"}


def test_seeds_become_medians_and_lost_ones_stay_visible():
    rows = [row(stiffness=k, seed=s, bias_rel=0.1 * s) for k in (1e2, 1e4) for s in range(5)]
    rows[-1] = failed("nonfinite", "1 of 32 estimates are not finite", stiffness=1e4, seed=4)
    merged = views.merge_seeds(table(rows))
    assert list(merged["bias_rel"]) == pytest.approx([0.2, 0.15])
    assert list(merged["lost"]) == [0, 1]
    panel = drawn(table(rows), ["stiffness"])["bias_variance_stiffness"].axes[0]
    assert [list(line.get_xdata()) for line in panel.lines if line.get_marker() == "x"] == [[pytest.approx(1e4)]]


@pytest.mark.parametrize(
    "rows",
    [
        [failed("error", "it broke", stiffness=k) for k in (1e2, 1e4)],
        [failed("unsupported", "it cannot", stiffness=k) for k in (1e2, 1e4)],
        [row(stiffness=k, reference_norm=0.0, bias_rel=math.nan, rmse_rel=math.nan) for k in (1e2, 1e4)],
        [row(stiffness=k, bias=0.0, bias_low=0.0, bias_high=0.0, variance=0.0, variance_low=0.0) for k in (1e2, 1e4)],
        [row(stiffness=k, bias=math.inf, bias_high=math.inf, variance=math.inf, rmse=math.inf) for k in (1e2, 1e4)],
        [row(stiffness=k, bias_low=math.nan, bias_high=math.nan, variance_high=math.inf) for k in (1e2, 1e4)],
        [row(stiffness=k, time_s=0.0, rmse_rel=0.0, backend=b) for k in (1e2, 1e4) for b in ("jax", "torch")],
        [row(stiffness=k, scene="$s_1", estimator="_x$") for k in (0.0, -1.0)],
        [row()],
    ],
    ids=["error", "unsupported", "no_gradient", "exact", "infinite", "no_interval", "no_time", "odd_names", "single"],
)
def test_odd_rows_break_nothing(rows, tmp_path, capsys):
    made = experiment(tmp_path)
    made.directory.mkdir()
    tables.write(table(rows), made.directory)
    charts.write(made, table(rows), ["sigma", "stiffness"], NAMES)
    terminal.show(made, table(rows), ["sigma", "stiffness"])
    assert capsys.readouterr().out


# ----------------------------------------------------------------------------------------------------------- paper


def figure_of_known_data():
    """Two panels: a line, points with intervals, an upper limit, a cross at the panel's edge."""
    with styled():
        made = Figure()
        upper, lower = made.subplots(2, 1)
        upper.set(title="up", ylabel="error")
        upper.plot([1, 2, 3], [10.0, 20.0, math.nan], label="a", color="#0072B2")
        upper.errorbar([1], [10.0], yerr=[[4.0], [5.0]], color="#0072B2", marker="o", linestyle="none")
        upper.plot([2], [20.0], marker="o", markerfacecolor="white", color="#0072B2", linestyle="none")
        upper.plot([9], [0.5], marker="x", transform=upper.get_xaxis_transform(), color="#0072B2")
        lower.errorbar([5.0], [6.0], xerr=[[1.0], [1.0]], label="b", color="#D55E00", marker="s")
        return made


def test_plotted_data_is_that_of_the_figure():
    found = plotted(figure_of_known_data())
    assert list(found["title"]) == ["up", "up", "up"]
    assert list(found["series"]) == ["a", "a", "b"]
    assert list(found["mark"]) == ["point", "limit", "point"]
    assert found[["x", "y"]].to_numpy().tolist() == [[1, 10], [2, 20], [5, 6]]
    assert found[["y_low", "y_high"]].iloc[0].tolist() == [6.0, 15.0]
    assert found[["x_low", "x_high"]].iloc[2].tolist() == [4.0, 6.0]


def test_every_bias_and_interval_of_the_rows_is_in_the_plotted_data(tmp_path):
    rows = stiffness_rows(sigmas=(0.1,), backends=("jax",), estimators=("fobg", "reinforce"))
    made = Experiment("made_up", {}, sweep={"stiffness": list(STIFFNESS)}, results_dir=tmp_path)
    (tmp_path / "made_up").mkdir()
    charts.write(made, rows, ["stiffness"], NAMES)
    found = pd.read_csv(tmp_path / "made_up" / "bias_variance_stiffness.plotted.csv")
    for _, cell in rows[rows["bias_low"] > 0].iterrows():
        ends = cell[["bias", "bias_low", "bias_high"]] / cell["reference_norm"]
        near = np.isclose(found[["y", "y_low", "y_high"]], ends.to_numpy(dtype=float), rtol=1e-6).all(axis=1)
        assert (found["series"][near] == cell["estimator"]).any()


def test_equal_figures_are_equal_files_with_their_fonts_inside(tmp_path):
    for name in ("first", "second"):
        with styled():
            paths = save(figure_of_known_data(), tmp_path / name)
        assert [path.name.partition(".")[2] for path in paths] == ["png", "svg", "pdf", "plotted.csv"]
    for path in paths:
        assert path.read_bytes() == (tmp_path / f"first.{path.name.partition('.')[2]}").read_bytes()
    pdf = (tmp_path / "first.pdf").read_bytes()
    assert b"/FontFile2" in pdf
    assert b"CreationDate" not in pdf
    assert b"<text" not in (tmp_path / "first.svg").read_bytes()


def test_best_is_told_only_where_its_interval_is_apart_from_every_other_estimator():
    def rows(other):
        made = [row(estimator=name, backend=backend) for name in ("fobg", "reinforce") for backend in ("jax", "torch")]
        known = table(made)
        known[["bias_low", "bias_high"]] = 0.0
        ends = {"fobg": (1.0, 2.0), "reinforce": other}
        for end, place in (("low", 0), ("high", 1)):
            known[f"variance_{end}"] = [ends[name][place] for name in known["estimator"]]
        return known.assign(rmse=[1.2 if name == "fobg" else 2.0 for name in known["estimator"]])

    assert tables.best(rows((2.5, 4.0))).tolist() == [True, True, False, False]
    assert not tables.best(rows((1.9, 4.0))).any()
    assert not tables.best(rows((2.5, 4.0)).assign(variance_low=math.nan)).any()
    assert tables.latex(tables.readable(rows((2.5, 4.0)))).count(r"\bfseries") == 2
    assert r"\bfseries" not in tables.latex(tables.readable(rows((1.9, 4.0))))


@pytest.mark.parametrize(
    ("texts", "form"),
    [(["0.10", "12", "-"], "2.2"), (["1.2e5", "-3"], "-1.1e1"), (["2.0e-7"], "1.1e-1"), (["0 (< 0.1)", "-"], "1.0")],
)
def test_column_format_holds_every_number(texts, form):
    assert tables.number_format(texts) == form


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex: apt-get install texlive-science")
@pytest.mark.parametrize("count", [30, 60])
def test_table_compiles_in_latex(count, tmp_path):
    rows = table(
        [row(scene=EVIL), failed("error", EVIL, scene="other"), *(row(stiffness=float(k + 1)) for k in range(count))]
    )
    rows.loc[2, ["bias", "bias_low"]] = 0.0
    tables.write(rows, tmp_path)
    packages = re.search(r"usepackage\{(.*)\}", (tmp_path / "bias_variance.tex").read_text())[1]
    text = rf"\documentclass{{article}}\usepackage{{{packages}}}\begin{{document}}\input{{bias_variance.tex}}\end{{document}}"
    (tmp_path / "paper.tex").write_text(text)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, errors="replace", timeout=120)
    assert done.returncode == 0, done.stdout[-2000:]
