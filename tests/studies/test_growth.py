"""Products of step Jacobians against closed forms, and verdicts on planted norms."""

import math

import numpy as np
import pytest
from bench.plugins.studies.growth import classify, fit, products, rate
from helpers import loaded

from bench.run.session import RunSession


def constant(matrix, horizon, batch=3):
    return np.broadcast_to(np.asarray(matrix)[None, :, :, None], (horizon, *np.shape(matrix), batch))


def test_products_beyond_the_range_of_floats():
    singular, spectral = products(constant([[10.0, 0.0], [0.0, 2.0]], 1000))
    assert singular[:, 0] == pytest.approx(1000 * math.log(10.0))
    assert spectral == pytest.approx(1000 * math.log(10.0))


def test_the_last_step_is_the_left_factor():
    """diag(2, 1) [[1, 1], [0, 1]] = [[2, 2], [0, 1]], whose squares add up to 9; the other product is [[2, 1], [0, 1]]."""
    singular, _ = products(np.array([[[1.0, 1.0], [0.0, 1.0]], [[2.0, 0.0], [0.0, 1.0]]])[..., None])
    assert np.exp(2 * singular).sum() == pytest.approx(9.0)


def test_what_is_measured_of_two_steps_of_a_free_mass_and_without_a_lost_gradient(monkeypatch):
    """q_2 = c . u with c = (2, 1) and u = (1, 1), so J = 2 and its gradient is 2 c; a zeroth-order term is nearly 2 (c . w) w."""
    words = "scenes=[double_integrator[horizon=2,dt=1,sigma=1e-3]]", "integrators=[semi_implicit_euler]"
    given, (cell,) = loaded(
        "study=growth", *words, "estimators=[fobg]", "backends=[implicit]", "samples=4000", "repeats=2"
    )
    session = RunSession(given)
    problem = session.problem(cell)
    right = problem.grad
    lost = np.arange(8000) == 5
    monkeypatch.setattr(problem, "grad", lambda theta, w: np.where(lost, math.nan, right(theta, w)))
    row = given.study.measure(cell, session)
    assert (row["status"], row["finite_fraction"]) == ("nonfinite", 7999 / 8000)
    assert row["gradient_median"] == pytest.approx(2 * math.sqrt(5), rel=1e-3)
    # 4 E (c . w)^2 |w|^2 - |2 c|^2 = 4 (4 - 1) 5, within nearly five standard errors
    assert row["zeroth_order_variance_mean"] == pytest.approx(60.0, rel=0.2)
    # of [[1, 2], [0, 1]]
    assert row["stretch_rate"] == pytest.approx(math.log(1 + math.sqrt(2)) / 2)
    assert row["spectral_rate"] == pytest.approx(0.0, abs=1e-6)  # sqrt(eps) of a defective eigenvalue


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        ([[1.1, 0.0], [0.3, 0.5]], "exploding"),
        ([[0.9, 0.1], [0.0, 0.5]], "vanishing"),
        ([[1.0, 0.1], [0.0, 1.0]], "neutral"),
        ([[0.0, 1.0], [-1.0, 0.0]], "neutral"),
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
        (np.exp(-TIMES), "vanishing"),
        (TIMES**-2, "vanishing"),
        (TIMES[:4], "growing"),
        (np.exp(TIMES[:3]), "growing"),
        (np.array([1.0, 100.0, 99.0, 100.0, 101.0]), "open"),
        (np.ones(5), "open"),
        (np.array([1.0, 100.0, 1.0, 100.0, 1.0]), "open"),
    ],
)
def test_verdicts_of_planted_norms(norms, verdict):
    count = len(norms)
    assert fit(TIMES[:count], norms, QUIET[:count])["verdict"] == verdict


@pytest.mark.parametrize(
    ("horizons", "norms", "errors"),
    [
        (TIMES[:3], np.exp(0.1 * TIMES[:3]), 1e2 * QUIET[:3]),
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
