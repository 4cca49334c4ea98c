"""The chart of error against time along an axis: one curve per estimator, each value of the axis told beside it."""

import itertools

import pytest
from helpers import experiment, row, table

from bench.report import views
from bench.report.figures import styled
from bench.report.plotted import plotted
from bench.report.problems import split_by_problem
from bench.studies.bias_variance import charts, findings

STIFFNESSES = (10.0, 100.0, 1000.0, 1e4)
SWEEP = {"sweep": {"stiffness": list(STIFFNESSES)}, "marks": {}}


def rows_of(error, time=lambda k, backend: 1e-3):
    """Rows of fobg with both laws, on two backends."""
    made = [
        row(
            stiffness=k, contact=law, backend=backend, rmse_rel=error(k, law), time_s=time(k, backend), estimator="fobg"
        )
        for k, law, backend in itertools.product(STIFFNESSES, ("penalty", "complementarity"), ("numpy", "jax"))
    ]
    return table(made)


def test_all_stiffnesses_are_one_curve_each_value_beside_it():
    """Each panel has one line through all stiffnesses, on the faster backend, and a label for every run of values."""
    rows = rows_of(
        lambda k, law: 100.0 if law == "penalty" and k == 1e4 else 0.1 + 1e-6 * k,
        lambda k, backend: {"numpy": 2e-3, "jax": 1e-3}[backend] * k**0.25,
    )
    with styled():
        figure = charts.figures(experiment(**SWEEP), rows)["time_stiffness"]
    data = plotted(figure)
    points = data[data["mark"] == "point"]
    assert points.groupby("panel").size().tolist() == [4, 4]
    assert points["x"].tolist() == pytest.approx([1e-3 * k**0.25 for k in STIFFNESSES] * 2)
    assert points["y"].max() == 100.0
    labels = [[text.get_text() for text in panel.texts] for panel in figure.axes[:2]]
    assert labels == [["10", "100", "1000", "1e4"]] * 2
    assert "penalty: fobg error up to 1000 times and time up to 5.6 times" in " ".join(_title(figure).split())
    assert "complementarity: fobg time up to 5.6 times" in " ".join(_title(figure).split())


def _title(figure):
    return max((text.get_text() for part in figure.subfigs for text in part.texts), key=lambda text: "Along" in text)


def test_values_at_one_place_share_a_label():
    with styled():
        figure = charts.figures(experiment(**SWEEP), rows_of(lambda k, law: 0.1))["time_stiffness"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["10-1e4"]
    assert "neither error nor time of fobg doubles" in " ".join(_title(figure).split())


def test_without_times_there_is_no_such_chart():
    rows = rows_of(lambda k, law: 0.1).assign(time_s=float("nan"))
    with styled():
        assert "time_stiffness" not in charts.figures(experiment(**SWEEP), rows)


def test_a_title_names_the_few_problems_that_fail():
    """Two problems that fail, in different ways, are told by name and place."""
    places = [("one", "none"), ("two", "penalty"), ("two", "softplus")]
    made = [
        row(scene=scene, contact=law, sigma=s, estimator="fobg", rmse_rel=9.0 if scene == "one" or (law == "penalty" and s > 0.1) else 0.1)
        for scene, law in places for s in (0.03, 0.1, 0.3, 1.0)
    ]  # fmt: skip
    shown = views.arrange(experiment(sweep={"sigma": [0.03, 0.1, 0.3, 1.0]}, marks={}), table(made))
    axis = next(axis for axis in shown.swept() if axis.column == "sigma")
    parts = [(part, views.estimator_curves(part.rows)) for part in split_by_problem(shown, axis)]
    assert findings.headline(parts, axis) == "fobg fails everywhere on one and from sigma 0.3 on two, penalty"
