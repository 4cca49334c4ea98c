"""Equal figures are equal files, whatever the solver of layouts leaves in the last bits."""

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bench.report import figures, scales


def half_a_pixel(shift):
    """A figure of 300 pixels with a text in axes that is half a pixel from its neighbours."""
    figure = Figure(figsize=(2, 2))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.25, 0.25 + shift, 0.5, 0.5))
    axes.text(0.5, 25.5 / 150, "inside")
    return figure


def test_last_bits_of_a_layout_move_nothing(tmp_path):
    files = []
    with figures.styled():
        for name, each in (("one", 0.0), ("two", 3e-14)):
            files.append(figures.save(half_a_pixel(each), tmp_path / name)[0].read_bytes())
    assert files[0] == files[1]


def test_one_value_on_a_logarithmic_axis_has_its_label():
    panel = Figure().subplots()
    scales.log_axis(panel, "x", 2.0, 4.5, [3.0])
    assert list(panel.get_xticks()) == [3.0]
