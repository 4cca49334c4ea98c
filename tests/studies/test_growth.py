"""Products of step Jacobians against closed forms, and verdicts on planted norms."""

import math

import numpy as np
import pytest
from bench.plugins.studies.growth import classify, fit, products, rate
from classes import DoubleIntegrator, Jax, SemiImplicitEuler

from bench.model import compose


def constant(matrix, horizon, batch=3):
    return np.broadcast_to(np.asarray(matrix)[None, :, :, None], (horizon, *np.shape(matrix), batch))


def test_spectral_radius_of_the_double_integrator():
    scene = DoubleIntegrator(horizon=30)
    problem = Jax().compile(compose(scene, None, SemiImplicitEuler()))
    _, spectral = products(problem.jacobians(scene.theta0(), np.zeros((30, 2))).a)
    assert spectral == pytest.approx(0.0, abs=1e-6)  # sqrt(eps) of a defective eigenvalue


def test_products_beyond_the_range_of_floats():
    singular, spectral = products(constant([[10.0, 0.0], [0.0, 2.0]], 1000))
    assert singular[:, 0] == pytest.approx(1000 * math.log(10.0))
    assert spectral == pytest.approx(1000 * math.log(10.0))


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
    singular, spectral = products(constant(matrix, 200))
    assert classify(rate(singular[:, 0], 200)[2], rate(spectral, 200)[1], 1e-6 / 200) == expected


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
