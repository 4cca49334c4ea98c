"""Products of step Jacobians against closed forms, and the growth study end to end."""

import math

import numpy as np
import pandas as pd
import pytest
from bench.plugins.backends.jax import Jax
from bench.plugins.integrators.rk4 import Rk4
from bench.plugins.integrators.semi_implicit_euler import SemiImplicitEuler
from bench.plugins.scenes.double_integrator import DoubleIntegrator
from bench.plugins.scenes.double_pendulum import DoublePendulum

from bench.cli import main
from bench.experiment import config
from bench.experiment.grid import cells
from bench.model import Jacobians, compose
from bench.report.views import arrange
from bench.run.store import Store
from bench.studies.growth import report
from bench.studies.growth.columns import COLUMNS
from bench.studies.growth.measure import classify, products, rate


def constant(matrix, horizon, batch=3):
    n = len(matrix)
    a = np.broadcast_to(np.asarray(matrix)[None, :, :, None], (horizon, n, n, batch))
    return Jacobians(
        np.zeros((horizon + 1, n, batch)), np.zeros((horizon, 0, batch)), a, np.zeros((horizon, n, 0, batch))
    )


def test_gain_of_the_double_integrator():
    scene = DoubleIntegrator(horizon=30)
    problem = Jax().compile(compose(scene, None, SemiImplicitEuler()))
    found = products(problem.jacobians(scene.theta0(), np.zeros((30, 2))))
    lag = np.arange(1, 31)
    expected = scene.dt * np.hypot(scene.dt * lag, 1.0)  # dx_N/du_i = (dt^2 lag, dt)
    assert np.exp(found.gain) == pytest.approx(np.repeat(expected[:, None], 2, axis=1), rel=1e-12)
    assert found.spectral == pytest.approx(0.0, abs=1e-6)  # sqrt(eps) of a defective eigenvalue


def test_products_beyond_the_range_of_floats():
    found = products(constant([[10.0, 0.0], [0.0, 2.0]], 1000))
    assert found.gain[-1] == pytest.approx(1000 * math.log(10.0))
    assert found.spectral == pytest.approx(1000 * math.log(10.0))


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        ([[1.1, 0.0], [0.3, 0.5]], "exploding"),
        ([[0.9, 0.1], [0.0, 0.5]], "vanishing"),
        ([[1.0, 0.1], [0.0, 1.0]], "neutral"),
        ([[math.cos(0.3), 2 * math.sin(0.3)], [-math.sin(0.3) / 2, math.cos(0.3)]], "neutral"),
    ],
)
def test_classes_of_constant_maps(matrix, expected):
    found = products(constant(matrix, 200))
    stretch, spectral = rate(found.singular[:, 0], 200), rate(found.spectral, 200)
    assert classify(stretch[2], spectral[1], 1e-6 / 200) == expected


def test_rate_interval_covers():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(1000):
        _, low, high = rate(10 * (0.3 + rng.standard_normal(16)), 10)
        hits += low <= 0.3 <= high
    assert abs(hits - 950) < 4 * math.sqrt(1000 * 0.95 * 0.05)


@pytest.mark.slow
def test_median_gradient_of_the_double_pendulum():
    for horizon, median in ((100, 8.0), (250, 26.0), (500, 580.0), (1000, 3.1e5)):
        scene = DoublePendulum(horizon=horizon)
        problem = Jax().compile(compose(scene, None, Rk4()))
        w = np.random.default_rng(0).standard_normal((4, 400))
        found = np.median(np.linalg.norm(problem.grad(scene.theta0(), w), axis=0))
        assert median / 1.5 < found < median * 1.5


@pytest.mark.slow
def test_from_the_command_line(tmp_path, capsys):
    words = [
        "study=growth", "name=small", "scenes=[double_integrator,double_pendulum]", "integrators=[rk4]",
        "estimators=[fobg]", "sweep.horizon=[10,50]", "samples=16", "repeats=4", f"results_dir={tmp_path}",
    ]  # fmt: skip
    assert main(words) == 0
    for name in ("csv", "md", "png"):
        assert (tmp_path / "small" / f"growth.{name}").stat().st_size > 0
    assert "spectral" in capsys.readouterr().out
    rows = Store(tmp_path / "small", COLUMNS).load().set_index(["scene", "horizon"])
    assert rows.loc[("double_integrator", 50.0), "growth"] == "neutral"
    chaotic = rows.loc[("double_pendulum", 50.0)]
    assert chaotic["growth"] == "exploding"
    assert chaotic["gain_of"] == "states"
    assert len(chaotic["lags"]) == len(chaotic["gain"])


def test_every_singular_value_and_the_gain_are_drawn():
    """Two scenes of 2 and 3 states, four rows of panels; what is below rounding is left out and said to be."""
    words = ["study=growth", "scenes=[bouncing_ball,hopper]", "integrators=[rk4]", "estimators=[fobg]"]
    given = config.load([*words, "sweep.horizon=[10,20]"])
    values = {"bouncing_ball": [10.0, 0.1], "hopper": [1e3, 1.0, 1e-15]}
    lines = []
    for cell in cells(given):
        row, t = cell.columns(), float(cell.scene.horizon)
        lines.append(COLUMNS.blank() | row | {
            "status": "ok", "dt": 0.1, "time_horizon": t, "gradient_median": t, "gradient_low": t / 2,
            "gradient_high": 2 * t, "growth": "exploding", "spectral_rate": 0.1, "lags": [1, 10], "gain": [1.0, 5.0],
            "gain_low": [0.5, 2.0], "gain_high": [2.0, 9.0], "gain_of": "states", "singular_values": values[row["scene"]],
            **{f"{order}_order_variance{end}": t for order in ("first", "zeroth") for end in ("", "_low", "_high")},
        })  # fmt: skip
    drawn = report.figure(arrange(given, pd.DataFrame(lines)))
    assert drawn is not None
    panels = np.array(drawn.axes).reshape(4, 2)
    shown = [{float(line.get_ydata()[0]) for line in panel.lines} for panel in panels[1]]
    assert shown[0] == {10.0, 0.1, 1.0}  # and the 1 at which nothing grows
    assert {value for value in shown[1] if math.isfinite(value)} == {1e3, 1.0}
    assert 5.0 in panels[2, 0].lines[0].get_ydata()
    assert report._ends([1e3, 1.0, 1e-15]) == "1000 to < 2.2e-13"
    assert report._ends([10.0, 0.1]) == "10 to 0.10"
