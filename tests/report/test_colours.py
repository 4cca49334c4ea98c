"""The palette as a reader without green cones sees it (deuteranopia), and estimators beyond its length."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pandas as pd
import pytest
from helpers import experiment
from matplotlib.colors import to_rgb

from bench.experiment.columns import Column
from bench.experiment.views import Chart, Views
from bench.report import writer
from bench.report.colours import method_styles
from bench.report.style import PALETTE, colour, marker

DEUTERANOPIA = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
)
"""On linear RGB, at full severity (Machado, Oliveira, Fernandes 2009)."""
EYES = {"normal": np.eye(3), "deutan": DEUTERANOPIA}
D65 = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


def lab(text, seen):
    """CIELAB coordinates of a colour after a matrix on linear RGB."""
    rgb = np.array(to_rgb(text))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = D65 @ np.clip(seen @ linear, 0.0, 1.0) / D65.sum(axis=1)
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def apart(a, b, seen):
    return float(np.linalg.norm(lab(a, seen) - lab(b, seen)))


def test_forty_estimators_have_forty_colours_each_apart_from_the_one_it_comes_from():
    found = [colour(place) for place in range(40)]
    assert found[: len(PALETTE)] == list(PALETTE)
    for place in range(len(PALETTE), 40):
        assert apart(found[place], PALETTE[place % len(PALETTE)], np.eye(3)) > 10
    assert min(apart(a, b, np.eye(3)) for a, b in combinations(found, 2)) > 5


@pytest.mark.parametrize("eyes", EYES)
def test_twelve_estimators_stay_distinct_for_colour_blind_readers_too(eyes):
    """Colours differ by 8 (just noticeable: 2.3), and by 30 where the marker is the same."""
    for a, b in combinations(range(12), 2):
        assert apart(colour(a), colour(b), EYES[eyes]) > (30 if marker(a) == marker(b) else 8)


def test_an_estimator_keeps_its_look_whatever_else_is_drawn():
    """fobg was blue in one experiment's searches, pink in another's."""
    names = ["reinforce", "fobg[a=1]", "fobg", "finite_difference", "of_my_own"]
    found = method_styles(names)
    assert len({(style.colour, style.marker) for style in found.values()}) == len(names)
    for name in set(names) - {"fobg[a=1]"}:
        assert method_styles([name]) == {name: found[name]}
    assert found["fobg[a=1]"].colour == found["fobg"].colour
    assert found["fobg[a=1]"].line != found["fobg"].line
    assert method_styles(["fobg, adam"])["fobg, adam"] == found["fobg"]


def test_a_search_keeps_its_look_and_differs_from_the_estimators_beside_it():
    """cem was pink, black and orange in three experiments, and ppo another colour as a trainer."""
    searches = ["cem[population=40]", "cma_es", "mppi", "ppo[population=40]"]
    found = method_styles([*searches, "fobg, adam", "reinforce, adam", "windowed, adam", "randomized_smoothing, lbfgs"])
    assert (
        len({style.colour for name, style in found.items() if name not in ("mppi", "randomized_smoothing, lbfgs")}) == 6
    )
    assert found["ppo[population=40]"] == method_styles(["ppo[rollouts=64]"])["ppo[rollouts=64]"]
    trainers = method_styles(["bptt", "evolution", "ppo", "sep_cma_es", "shac"])
    assert len({style.colour for style in trainers.values()}) == 5


def test_a_name_has_one_colour_in_all_charts_of_an_experiment():
    """A search without an estimator was orange in one chart and brown in the next, by its place."""
    names = ["cma_es", "fobg, adam", "ppo"]
    charts = [
        Chart(
            str(turn),
            pd.DataFrame({"x": [1.0] * 3, "name": names[turn:] + names[:turn]}),
            [Column("x")],
            [Column("x")],
            "points",
            series="name",
            title=str(turn),
        )
        for turn in range(3)
    ]
    figures = [figure for _, (figure,) in writer.drawings(replace(experiment(), question="Why?"), Views(charts=charts))]
    assert [figure.texts[0].get_text() for figure in figures] == ["Why?", "1", "2"], "the main chart has the question"
    found = [{line.get_label(): line.get_color() for line in figure.legends[0].get_lines()} for figure in figures]
    assert found == found[:1] * 3
    assert len(set(found[0].values())) == 3
