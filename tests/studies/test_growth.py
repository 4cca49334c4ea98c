"""Products of step Jacobians against closed forms, and the growth study end to end."""

import math

import numpy as np
import pandas as pd
import pytest
from bench.plugins.studies.growth import Growth, classify, products, rate
from bench.plugins.studies.growth.views import fit
from classes import DoubleIntegrator, Jax, SemiImplicitEuler

from bench.experiment import config
from bench.experiment.grid import cells
from bench.model import Jacobians, compose
from bench.report.cells import readable

COLUMNS = Growth.columns


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


TIMES = np.array([0.5, 1.0, 2.5, 5.0, 10.0])
QUIET = np.full(5, 1e-3)


@pytest.mark.parametrize(
    ("norms", "verdict"),
    [
        (TIMES**3, "polynomial"),
        (np.sqrt(TIMES), "polynomial"),
        (np.exp(1.2 * TIMES), "exploding"),
        (TIMES * np.exp(2.0 * TIMES), "exploding"),
        (np.exp(-TIMES), "vanishing"),
        (TIMES**-2, "vanishing"),
        (np.ones(5), "open"),
        (np.array([1.0, 100.0, 1.0, 100.0, 1.0]), "open"),
    ],
)
def test_verdicts_of_planted_norms(norms, verdict):
    assert fit(TIMES, norms, QUIET)["verdict"] == verdict


@pytest.mark.parametrize(
    ("horizons", "norms", "errors"),
    [
        (TIMES[:4], np.exp(TIMES[:4]), QUIET[:4]),
        (TIMES[:1], np.ones(1), QUIET[:1]),
        (np.ones(5), np.exp(TIMES), QUIET),  # equal horizons, such as seeds
        (TIMES, np.exp(0.3 * TIMES), 1e3 * QUIET),  # norms known within a factor of e
    ],
)
def test_few_horizons_and_uncertain_norms_are_open(horizons, norms, errors):
    assert fit(horizons, norms, errors)["verdict"] == "open"


@pytest.mark.parametrize("count", [5, 8])
def test_at_most_one_power_law_in_twenty_counts_as_exploding(count):
    rng, horizons = np.random.default_rng(0), np.geomspace(0.5, 10.0, count)
    for order, spread in ((0.5, 0.3), (1.0, 0.6), (3.0, 2.0)):
        noise = spread * rng.standard_normal((500, count))
        found = [fit(horizons, horizons**order * np.exp(n), np.zeros(count))["verdict"] for n in noise]
        assert found.count("exploding") <= 500 * 0.05 + 3 * math.sqrt(500 * 0.05 * 0.95)


def grown(*words):
    """Two scenes of 2 and 3 states over five horizons: norms of one rise like t^2, of the other like e^t."""
    given = config.load(
        ["study=growth", "scenes=[bouncing_ball,hopper]", "integrators=[rk4]", "estimators=[fobg]",
         "sweep.horizon=[10,20,50,100,200]", *words]
    )  # fmt: skip
    values = {"bouncing_ball": [10.0, 0.1], "hopper": [1e3, 1.0, 1e-15]}
    lines = []
    for cell in cells(given):
        row, t = cell.columns(), 0.1 * cell.scene.horizon
        norm = t**2 if row["scene"] == "bouncing_ball" else math.exp(t)
        lines.append(COLUMNS.blank() | row | {
            "status": "ok", "dt": 0.1, "time_horizon": t, "gradient_median": norm, "gradient_low": norm / 2,
            "gradient_quarter": norm / 1.1, "gradient_three_quarters": norm * 1.1, "gradient_high": 2 * norm,
            "finite_fraction": 1.0, "growth": "exploding", "spectral_rate": 0.1, "spectral_low": 0.05, "spectral_high": 0.2,
            "lags": [1, 10], "gain": [1.0, 5.0], "gain_low": [0.5, 2.0], "gain_high": [2.0, 9.0], "gain_of": "states",
            "singular_values": values[row["scene"]],
            **{f"first_order_variance{end}": t for end in ("", "_low", "_high")},
            **{f"zeroth_order_variance{end}": 3.0 for end in ("", "_low", "_high")},
        })  # fmt: skip
    return given, given.columns.typed(pd.DataFrame(lines))


def test_charts_and_tables_of_planted_rows():
    given, rows = grown()
    shown = given.study.views(given, rows)
    (norms,) = shown.charts
    assert norms.panel_notes == {"bouncing_ball": "polynomial", "hopper": "exploding"}
    assert list(norms.frame["row"]) == list(range(10))
    answers, table = map(readable, shown.tables)
    assert list(answers["verdict"]) == ["polynomial", "exploding"]
    assert list(answers["lower variance"]) == ["zeroth"] * 2
    assert list(answers["from [s]"]) == ["5"] * 2
    assert (answers["order"][0], answers["rate [1/s]"][1]) == ("2.0 [2.0, 2.0]", "1.0 [1.0, 1.0]")
    assert table["spectral [1/s]"][0] == "1.0 [0.50, 2.0]", "per second, at steps of 0.1 s"


def test_ranges_of_variances_that_overlap_and_lost_horizons_are_open():
    given, rows = grown()
    rows["first_order_variance_low"], rows["first_order_variance_high"] = 0.0, 1e9
    lost = rows["horizon"] > 50
    rows.loc[lost, ["gradient_median", "gradient_quarter"]] = math.nan
    rows.loc[lost, "status"] = "nonfinite"
    shown = given.study.views(given, rows)
    assert list(shown.tables[0].frame["verdict"]) == ["open", "open"]
    assert list(shown.tables[0].frame["lower"]) == ["open"] * 2
    assert len(shown.tables[1].frame) == len(rows)
