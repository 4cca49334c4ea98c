"""Equal figures are equal files, whatever the solver of layouts leaves in the last bits."""

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bench.report import draw, figures, scales
from bench.report.style import width_in_inches


def half_a_pixel(shift):
    """A figure of 300 pixels with a text in axes that is half a pixel from its neighbours."""
    figure = Figure(figsize=(2, 2))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.25, 0.25 + shift, 0.5, 0.5))
    axes.text(0.5, 25.5 / 150, "inside")
    return figure


@pytest.mark.parametrize("shift", [1e-15, -1e-15, 3e-14])
def test_last_bits_of_a_layout_move_nothing(shift, tmp_path):
    files = []
    with figures.styled():
        for name, each in (("one", 0.0), ("two", shift)):
            files.append(figures.save(half_a_pixel(each), tmp_path / name)[0].read_bytes())
    assert files[0] == files[1]


def test_a_layout_is_computed_once_and_kept_for_all_formats(tmp_path):
    figure = Figure(figsize=(3, 2), layout="constrained")
    FigureCanvasAgg(figure)
    for part in figure.subplots(1, 2):
        part.set_ylabel("a long label")
    figures.save(figure, tmp_path / "chart", ("png", "svg"))
    for axes in figure.axes:
        assert axes.get_position().bounds == pytest.approx([round(x, 6) for x in axes.get_position().bounds], abs=1e-12)
    assert all(axes.get_tightbbox().x0 >= -1 for axes in figure.axes), "labels are inside the figure"


def test_one_value_on_a_logarithmic_axis_has_its_label():
    panel = Figure().subplots()
    scales.log_axis(panel, "x", 2.0, 4.5, [3.0])
    assert list(panel.get_xticks()) == [3.0]


def test_a_title_without_spaces_breaks_after_commas_and_slashes():
    name = "mjcf[action_scale=1,file=gymnasium:envs/mujoco/assets/half_cheetah.xml,substeps=5]"
    lines = draw._wrapped(name, 2.0).split("\n")
    assert "".join(lines) == name
    assert all(width_in_inches(line) <= 2.0 for line in lines)
    assert draw._wrapped("two_balls, T=60", 2.0) == "two_balls, T=60"
